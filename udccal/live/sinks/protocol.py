"""The protocol that every sink implements, and the sink that a person names."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, final, runtime_checkable

import numpy as np
from jaxtyping import UInt8

from udccal.arguments import check_number
from udccal.errors import LiveError
from udccal.plugins import find_sink


@final
@dataclass(frozen=True)
class RestoredFrame:
    """A restored frame on its way out.

    Attributes:
        picture: display-encoded RGB. The sink may keep it, but must not write to it.
        frame_id: the camera's count.
        captured_ns: when the frame arrived from the camera, on the clock of ``time.monotonic_ns``.
    """

    picture: UInt8[np.ndarray, "rows columns 3"]
    frame_id: int
    captured_ns: int


@runtime_checkable
class Sink(Protocol):
    """Takes restored frames, all of one size; one thread calls ``open``, ``write`` and ``close`` in this order.

    A sink is made from what follows its name on the command line and from the rate of the frames in Hz. Making one
    leaves nothing behind, and refuses what it can know to be wrong, such as a folder that cannot be written to.
    """

    def __init__(self, target: str, rate_hz: float) -> None: ...

    def open(self, shape: tuple[int, int]) -> None:
        """Begin, for pictures of ``shape`` (rows, columns). Raise LiveError where that cannot be."""
        ...

    def write(self, frame: RestoredFrame) -> None:
        """Take a frame. Raise LiveError or OSError where that cannot be."""
        ...

    def close(self) -> None:
        """End; what was written is whole afterwards. Called after an error in ``open`` or ``write``, too."""
        ...


def make_sink(text: str, rate_hz: float) -> Sink:
    """Return the sink of ``NAME:TARGET``; nothing is opened yet.

    Args:
        text: name of an installed sink, and after a colon what it writes to.
        rate_hz: rate of the frames.

    Raises:
        UdccalError: when there is no such sink, or it refuses its target.
    """
    check_number(rate_hz, "a rate of frames in Hz", (1e-3, 1e5), "Give that of the camera.", LiveError)
    name, _, target = text.partition(":")
    sink: Sink = find_sink(name)(target, rate_hz)
    return sink
