"""An open camera's parts; starts and stops its frames."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from typing import Final, final

from udccal.cameras.u3v.control import ControlChannel
from udccal.cameras.u3v.layout import StreamRegisters
from udccal.cameras.u3v.nodes import NodeMap
from udccal.cameras.u3v.transport import UsbLink
from udccal.errors import CameraError, CameraTimeout

# A camera may finish the current exposure before it reports that it has stopped.
_STOP_S: Final = 15.0


@final
@dataclass(frozen=True)
class Device:
    """An open camera's parts."""

    link: UsbLink
    control: ControlChannel
    registers: StreamRegisters
    nodes: NodeMap

    def stop(self) -> None:
        """Stop frames and stream; take each step even if one before it fails.

        Raises:
            CameraError: the first failure, after all steps.
        """
        failures: list[CameraError] = []
        for step in (self._stop_acquisition, self.registers.disable, self.link.flush_stream, self._unlock):
            try:
                step()
            except CameraError as error:
                failures.append(error)
        if failures:
            raise failures[0]

    def leave_any_run(self) -> None:
        """Stop frames that an earlier run, or another program that was killed, may have left running."""
        # A camera that does not run may refuse to be stopped; one that is gone fails at the next command.
        with contextlib.suppress(CameraError):
            self.stop()

    def start(self) -> None:
        """Start the stream and frames; the stream's transfers must be agreed on before."""
        self.registers.enable()
        if self.nodes.writable("TLParamsLocked"):
            self.nodes.set_number("TLParamsLocked", 1)
        # Some cameras report the command as running for as long as they take frames.
        with contextlib.suppress(CameraTimeout):
            self.nodes.execute("AcquisitionStart")

    def _stop_acquisition(self) -> None:
        self.nodes.execute("AcquisitionStop", _STOP_S)

    def _unlock(self) -> None:
        if self.nodes.writable("TLParamsLocked"):
            self.nodes.set_number("TLParamsLocked", 0)
