"""One run of a camera: started, its blocks read and made frames of, and stopped again whatever happens."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from typing import Final, final

from udccal.cameras.protocol import Frame, Trigger
from udccal.cameras.u3v.device import Device
from udccal.cameras.u3v.pictures import PictureReader
from udccal.cameras.u3v.readahead import ReadAhead
from udccal.cameras.u3v.receiver import Block, Receiver
from udccal.errors import CameraError, CameraTimeout

_READY_POLL_S: Final = 2e-3
# After a trigger that may have arrived twice, a second frame would begin within this time.
_TWICE_S: Final = 0.5

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
        """Frames, each with how many were lost between the one before and it.

        Args:
            first_id: of the first frame; block ids begin anew with each run.

        Raises:
            CameraTimeout, CameraLost, CameraProtocolError, CameraError: as for ``Camera.frames``.
        """
        self.device.leave_any_run()
        layout = self.device.registers.configure(self.device.link.stream_packet)
        receiver = Receiver(self.device.link, layout, self.timeout_s)
        blocks = self._blocks(receiver, count)
        previous: int | None = None
        try:
            self.device.start()
            for payload, block in blocks:
                block_id = block.leader.block_id
                lost = 0 if previous is None else block_id - previous - 1
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
        for _ in range(max(1, round(self.wait_s / _READY_POLL_S))):
            nodes.refresh()
            if nodes.flag("AcquisitionStatus"):
                return
            time.sleep(_READY_POLL_S)
        raise CameraTimeout("Expected the camera to take a trigger, found it busy. Shorten the exposure or try again.")


def _never() -> bool:
    return False
