"""Turns block ids of transport layers into one rising count."""

from __future__ import annotations

from typing import Final, final

_INVALID: Final = 2**64 - 1
_GIGE_LAST: Final = 65535
_HALF_TURN: Final = 32768


@final
class FrameIds:
    """Numbers the frames of one opening; devices restart with each stream, these numbers continue.

    USB3 Vision counts from 0 in 64 bits. GigE Vision without extended ids counts from 1 to 65535 and begins at 1 again.
    A device that does not count sends 0 or all ones; then the SDK's own count of received images replaces it.
    """

    def __init__(self) -> None:
        """Start with no frames."""
        self._turns = 0
        self._last_block = 0
        self._last: int | None = None  # as the device counts, with 16-bit overflows added
        self._last_number = -1

    def begin_stream(self) -> None:
        """Note that the next frame is the first of a stream."""
        self._turns, self._last_block, self._last = 0, 0, None

    def next(self, block_id: int, image_number: int) -> tuple[int, int]:
        """Return the number of a frame, and how many before it never arrived.

        Args:
            block_id: the device's count.
            image_number: the SDK's count of this stream's images, from 1.
        """
        if block_id in (0, _INVALID):
            counted = image_number - 1
        else:
            if block_id + _HALF_TURN < self._last_block <= _GIGE_LAST:
                self._turns += 1
            counted = block_id + self._turns * _GIGE_LAST
            self._last_block = block_id
        step = 1 if self._last is None else counted - self._last
        self._last = counted
        self._last_number += step
        return self._last_number, max(0, step - 1)
