"""One run of a camera: starts it, reads its blocks, makes frames of them, and stops it whatever happens."""

from __future__ import annotations

import contextlib
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from typing import Final, final

from udccal.cameras.protocol import Frame, Mode, Settings, Trigger
from udccal.cameras.u3v.device import Device
from udccal.cameras.u3v.pictures import PictureReader
from udccal.cameras.u3v.polling import comes_true
from udccal.cameras.u3v.readahead import ReadAhead
from udccal.cameras.u3v.receiver import Block, Receiver
from udccal.errors import CameraError, CameraTimeout

_READY_POLL_S: Final = 2e-3
# After a trigger that may have arrived twice, a second frame would begin within this time.
_TWICE_S: Final = 0.5
# Limits of the wait for a frame, whatever the camera reports: the longest exposure, and the time beyond it.
_MOST_EXPOSURE_S: Final = 3600.0
_MOST_PERIOD_S: Final = 120.0

Blocks = Generator[tuple[memoryview, Block], None, None]


@final
@dataclass(frozen=True)
class Acquisition:
    """How frames are taken.

    Attributes:
        wait_s: longest wait for a frame.
        timeout_s: limit of each transfer within a frame.
    """

    device: Device
    reader: PictureReader
    trigger: Trigger
    wait_s: float
    timeout_s: float

    def frames(self, count: int, first_id: int) -> Iterator[tuple[Frame, int]]:
        """Yield frames, each with the number of frames lost since the one before or the start.

        Args:
            first_id: id of the first frame; the camera's own block ids restart with each run.

        Raises:
            CameraTimeout, CameraLost, CameraProtocolError, CameraError: as for ``Camera.frames``.
        """
        self.device.leave_any_run()
        layout = self.device.registers.configure(self.device.link.stream_packet)
        receiver = Receiver(self.device.link, layout, self.timeout_s)
        blocks = self._blocks(receiver, count)
        previous = -1  # ids count from 0 (USB3 Vision 1.0): frames missing before the first are lost as well
        try:
            self.device.start()
            for payload, block in blocks:
                block_id = block.leader.block_id
                lost = block_id - previous - 1
                first_id += lost
                previous = block_id
                yield self.reader.frame(payload, block, first_id), lost
                first_id += 1
        except BaseException:
            blocks.close()
            with contextlib.suppress(CameraError):  # the first error is raised
                self.device.stop()
            raise
        blocks.close()
        self.device.stop()

    def _blocks(self, receiver: Receiver, count: int) -> Blocks:
        if self.trigger is Trigger.SOFTWARE:
            return self._triggered(receiver, count)
        return ReadAhead(receiver, count, self.wait_s).blocks()

    def _triggered(self, receiver: Receiver, count: int) -> Blocks:
        """Yield a block for each trigger, which is sent when the block is requested."""
        payload = memoryview(bytearray(receiver.room))
        for _ in range(count):
            self._await_ready()
            resent = self.device.control.resent
            self.device.nodes.execute("TriggerSoftware")
            block = receiver.receive(payload, self.wait_s, _never)
            if block is None:
                return
            if self.device.control.resent != resent:
                # The frame of a second trigger would be taken for that of the next, but exposed before its request.
                with contextlib.suppress(CameraTimeout):
                    unwanted = memoryview(bytearray(receiver.room))
                    receiver.receive(unwanted, self.reader.settings.exposure_s + _TWICE_S, _never)
            yield payload, block

    def _await_ready(self) -> None:
        """Wait until the camera accepts a trigger, if it reports this; an earlier trigger is lost."""
        nodes = self.device.nodes
        if not nodes.has("AcquisitionStatusSelector"):
            return
        if "FrameTriggerWait" not in nodes.choices("AcquisitionStatusSelector"):
            return
        nodes.choose("AcquisitionStatusSelector", "FrameTriggerWait")

        def ready() -> bool:
            nodes.refresh()
            return nodes.flag("AcquisitionStatus")

        if not comes_true(ready, self.wait_s, _READY_POLL_S):
            raise CameraTimeout(
                "Expected the camera to accept a trigger, found it busy. Shorten the exposure or try again."
            )


def frame_wait_s(settings: Settings, mode: Mode, timeout_s: float) -> float:
    """Return the longest wait for a frame in s: its exposure, or the frame rate's period, plus a time-out.

    Args:
        mode: with a frame rate above 0 Hz, or none.
    """
    exposure_s = min(settings.exposure_s, _MOST_EXPOSURE_S)
    if mode.frame_rate_hz is None or mode.trigger is not Trigger.FREE_RUN:
        return exposure_s + timeout_s
    return min(max(exposure_s, 1.0 / mode.frame_rate_hz), exposure_s + _MOST_PERIOD_S) + timeout_s


def _never() -> bool:
    return False
