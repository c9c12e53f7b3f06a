"""One run of a camera: started, its blocks read and made frames of, and stopped again whatever happens."""

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
# Whatever the camera says, frames are not waited for longer than an exposure of this length, and this much beyond it.
_MOST_EXPOSURE_S: Final = 3600.0
_MOST_PERIOD_S: Final = 120.0

Blocks = Generator[tuple[memoryview, Block], None, None]


@final
@dataclass(frozen=True)
class Acquisition:
    """How frames are taken.

    Attributes:
        wait_s: longest wait for a frame.
        timeout_s: for each transfer within a frame.
    """

    device: Device
    reader: PictureReader
    trigger: Trigger
    wait_s: float
    timeout_s: float

    def frames(self, count: int, first_id: int) -> Iterator[tuple[Frame, int]]:
        """Frames, each with how many were lost between the one before, or the start, and it.

        Args:
            first_id: of the first frame that the camera takes; block ids begin anew with each run.

        Raises:
            CameraTimeout, CameraLost, CameraProtocolError, CameraError: as for ``Camera.frames``.
        """
        self.device.leave_any_run()
        layout = self.device.registers.configure(self.device.link.stream_packet)
        receiver = Receiver(self.device.link, layout, self.timeout_s)
        blocks = self._blocks(receiver, count)
        previous = -1  # ids count from 0 (USB3 Vision 1.0): what is missing before the first is lost as well
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
            with contextlib.suppress(CameraError):  # what happened first is told
                self.device.stop()
            raise
        blocks.close()
        self.device.stop()

    def _blocks(self, receiver: Receiver, count: int) -> Blocks:
        if self.trigger is Trigger.SOFTWARE:
            return self._triggered(receiver, count)
        return ReadAhead(receiver, count, self.wait_s).blocks()

    def _triggered(self, receiver: Receiver, count: int) -> Blocks:
        """A block for each trigger, which is given when the block is asked for."""
        payload = memoryview(bytearray(receiver.room))
        for _ in range(count):
            self._await_ready()
            resent = self.device.control.resent
            self.device.nodes.execute("TriggerSoftware")
            block = receiver.receive(payload, self.wait_s, _never)
            if block is None:
                return
            if self.device.control.resent != resent:
                # The frame of a second trigger would be taken for that of the next, exposed before it was asked for.
                with contextlib.suppress(CameraTimeout):
                    unwanted = memoryview(bytearray(receiver.room))
                    receiver.receive(unwanted, self.reader.settings.exposure_s + _TWICE_S, _never)
            yield payload, block

    def _await_ready(self) -> None:
        """Wait until the camera takes a trigger, if it says so; one that comes too early is lost."""
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
                "Expected the camera to take a trigger, found it busy. Shorten the exposure or try again."
            )


def frame_wait_s(settings: Settings, mode: Mode, timeout_s: float) -> float:
    """Longest wait for a frame: its exposure, or the frame rate's period, and a time-out on top; s.

    Args:
        mode: with a frame rate above 0 Hz, or none.
    """
    exposure_s = min(settings.exposure_s, _MOST_EXPOSURE_S)
    if mode.frame_rate_hz is None or mode.trigger is not Trigger.FREE_RUN:
        return exposure_s + timeout_s
    return min(max(exposure_s, 1.0 / mode.frame_rate_hz), exposure_s + _MOST_PERIOD_S) + timeout_s


def _never() -> bool:
    return False
