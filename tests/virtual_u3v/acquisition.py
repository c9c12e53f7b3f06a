"""When the camera exposes, and what becomes of each exposure."""

from __future__ import annotations

import enum
from collections import deque
from collections.abc import Callable
from typing import final

from tests.virtual_u3v import registers as at
from tests.virtual_u3v.bulk_in import BulkIn
from tests.virtual_u3v.chunks import ChunkValues, appended
from tests.virtual_u3v.clock import Clock
from tests.virtual_u3v.faults import FaultInjector
from tests.virtual_u3v.features import Features, Rule
from tests.virtual_u3v.memory import Memory, Refused, Status
from tests.virtual_u3v.pixel_formats import Packer
from tests.virtual_u3v.registers import Register
from tests.virtual_u3v.sources import Exposure, FrameSource
from tests.virtual_u3v.stream_interface import StreamInterface
from tests.virtual_u3v.stream_protocol import StreamFrame, messages


class Mode(enum.IntEnum):
    """SFNC's AcquisitionMode."""

    CONTINUOUS = 0
    SINGLE_FRAME = 1
    MULTI_FRAME = 2


class TriggerSource(enum.IntEnum):
    """SFNC's TriggerSource."""

    SOFTWARE = 0
    LINE1 = 1


@final
class Acquisition:
    """Exposes frames between AcquisitionStart and AcquisitionStop, one when the last has left for the host.

    A host that is slow therefore slows the camera down and loses nothing; frames are lost when that is ordered.
    """

    def __init__(
        self,
        memory: Memory,
        features: Features,
        stream: StreamInterface,
        endpoint: BulkIn,
        source: FrameSource,
        bits: int,
        clock: Clock,
        injector: Callable[[], FaultInjector],
    ) -> None:
        self._memory = memory
        self._features = features
        self._stream = stream
        self._endpoint = endpoint
        self._source = source
        self._bits = bits
        self._packer = Packer(bits)
        self._clock = clock
        self._injector = injector
        self._exposed = 0
        self._triggers_ns: deque[int] = deque()
        self._next_ns = 0
        self._left: int | None = None
        self._block_id = 0
        self.running = False

    def rules(self) -> dict[Register, Rule]:
        """What happens when one of the commands is written."""
        return {
            at.ACQUISITION_START: self._start,
            at.ACQUISITION_STOP: self._stop,
            at.TRIGGER_SOFTWARE: lambda value: self._trigger(TriggerSource.SOFTWARE),
        }

    def pulse(self) -> None:
        """A signal at the trigger input, Line1; ignored unless the camera waits for one."""
        if self._memory.uint(at.TRIGGER_SOURCE) == TriggerSource.LINE1:
            self._trigger(TriggerSource.LINE1)

    def next_frame_ns(self) -> int | None:
        """When the next frame is exposed and read out; None when there will be none."""
        start = self._next_start_ns()
        return None if start is None else start + round(1e3 * self._features.exposure_us(self._exposed))

    def pump(self) -> None:
        """Expose what is due, and queue it for the host, one frame at a time."""
        due = self.next_frame_ns()
        if due is not None and self._endpoint.empty and due <= self._clock.now_ns():
            self._expose()

    def _start(self, value: int) -> int:
        if not self.running:
            count = {Mode.CONTINUOUS: None, Mode.SINGLE_FRAME: 1}
            mode = Mode(self._memory.uint(at.ACQUISITION_MODE))
            self._left = count.get(mode, self._memory.uint(at.ACQUISITION_FRAME_COUNT))
            self._block_id, self._next_ns, self.running = 0, self._clock.now_ns(), True
            self._triggers_ns.clear()
        return 0

    def _stop(self, value: int) -> int:
        self.running = False
        return 0

    def _trigger(self, source: TriggerSource) -> int:
        if self._memory.uint(at.TRIGGER_SOURCE) != source:
            raise Refused(Status.ACCESS_DENIED)
        if self.running and self._memory.uint(at.TRIGGER_MODE):
            self._triggers_ns.append(self._clock.now_ns())
        return 0

    def _next_start_ns(self) -> int | None:
        if not self.running or self._left == 0 or not self._stream.enabled:
            return None
        if not self._memory.uint(at.TRIGGER_MODE):
            return self._next_ns
        return max(self._next_ns, self._triggers_ns[0]) if self._triggers_ns else None

    def _expose(self) -> None:
        x, y, columns, rows = self._features.region
        exposure_us = self._features.exposure_us(self._exposed)
        gain_steps = self._features.gain_steps(self._exposed)
        start_ns = max(self._next_start_ns() or 0, self._clock.now_ns() - round(1e3 * exposure_us))
        exposure = Exposure(self._block_id, start_ns, exposure_us, gain_steps, self._bits, x, y, columns, rows)
        number = self._injector().next_frame()
        frame = self._frame(exposure)
        faults = self._injector().faults
        for message in messages(frame, number, faults, start_ns + round(1e3 * exposure_us)):
            self._endpoint.push(message)
        self._advance(start_ns)
        if number == faults.hang_at_frame:
            self.running = False

    def _advance(self, start_ns: int) -> None:
        self._exposed += 1
        self._block_id += 1
        self._next_ns = start_ns + round(1e9 / self._features.frame_rate_hz)
        if self._triggers_ns:
            self._triggers_ns.popleft()
        if self._left is not None:
            self._left -= 1

    def _frame(self, exposure: Exposure) -> StreamFrame:
        pixel_format = self._features.pixel_format
        payload = self._packer.payload(self._source(exposure), pixel_format)
        chunks = self._features.chunks
        if chunks is not None:
            gain_db = exposure.gain_steps / 10
            values = ChunkValues(exposure.exposure_us, gain_db, exposure.start_ns, exposure.block_id)
            payload = appended(payload, chunks, values)
        place = (exposure.x, exposure.y, exposure.columns, exposure.rows)
        head = (exposure.block_id, exposure.start_ns, pixel_format.code)
        return StreamFrame(*head, *place, chunks is not None, payload, self._stream.room)
