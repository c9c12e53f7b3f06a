"""A USB3 Vision camera: what it does with the transfers that a host sends it."""

from __future__ import annotations

import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import final

from tests.virtual_u3v import bootstrap
from tests.virtual_u3v import registers as at
from tests.virtual_u3v.acquisition import Acquisition
from tests.virtual_u3v.bulk_in import BulkIn, Message
from tests.virtual_u3v.clock import Clock, SimulatedClock
from tests.virtual_u3v.control_channel import ControlChannel
from tests.virtual_u3v.descriptors import CONTROL_IN, CONTROL_OUT, EVENT_IN, STREAM_IN, Descriptors, descriptors_of
from tests.virtual_u3v.faults import FaultInjector, Faults
from tests.virtual_u3v.features import Features
from tests.virtual_u3v.gencp_server import GenCpServer
from tests.virtual_u3v.manifest import manifest_of
from tests.virtual_u3v.memory import Memory, Refused, Status
from tests.virtual_u3v.model import CameraModel, Speed
from tests.virtual_u3v.sources import FrameSource, PatternSource
from tests.virtual_u3v.standard_requests import DefaultPipe, Request, Setup
from tests.virtual_u3v.stream_interface import StreamInterface
from tests.virtual_u3v.usb_faults import Stalled, Unplugged

_EVENT_PREFIX, _EVENT_COMMAND, _TEST_EVENT = 0x4556_3355, 0x0C00, 0x4FFF


@final
class VirtualCamera:
    """A camera on a USB port; safe to use from several threads.

    Args:
        model: what kind of camera.
        source: where its light comes from; by default a pattern in which every sample identifies its place.
        faults: what goes wrong from the start.
        speed: of the link: a SuperSpeed camera on a USB 2 port has Speed.HIGH.
        clock: simulated by default.
    """

    def __init__(
        self,
        model: CameraModel | None = None,
        source: FrameSource | None = None,
        faults: Faults | None = None,
        speed: Speed = Speed.SUPER,
        clock: Clock | None = None,
    ) -> None:
        self.model = model or CameraModel()
        self.speed = speed
        self.clock = clock or SimulatedClock()
        self.address = 0
        self.plugged = False
        self._source = source or PatternSource()
        self._injector = FaultInjector(faults or Faults())
        self._lock = threading.RLock()
        self.plug()

    @property
    def faults(self) -> Faults:
        """What was ordered last."""
        return self._injector.faults

    def inject(self, faults: Faults) -> None:
        """Order faults in place of those before; their commands and frames count from here."""
        with self._lock:
            self._injector = FaultInjector(faults)

    def plug(self) -> None:
        """Put it into the port: it gets power and a new address, and has forgotten everything."""
        with self._lock:
            if not self.plugged:
                self.address += 1
                self._power_on()
                self.plugged = True

    def unplug(self) -> None:
        """Pull the cable."""
        with self._lock:
            self.plugged = False

    def pulse(self) -> None:
        """Give a signal on Line1, the trigger input."""
        with self._present():
            self._acquisition.pulse()

    @property
    def descriptors(self) -> Descriptors:
        """The descriptors as the host sees them now."""
        return descriptors_of(self.model, self.speed, address=self.address)

    def control(self, setup: Setup) -> bytes:
        """A transfer on endpoint 0; raises Stalled for what the camera does not know, or Unplugged.

        An endpoint that the host halts loses what waits behind it: so a host empties the stream (USB3 Vision 1.0 §5.3).
        """
        with self._present():
            answer = self._pipe.request(setup)
            if setup.bRequest == Request.SET_FEATURE and setup.wIndex in self._pipe.halted & self._queues.keys():
                self._queues[setup.wIndex].clear()
            return answer

    def bulk_out(self, endpoint: int, data: bytes) -> None:
        """A bulk OUT transfer; raises Stalled or Unplugged."""
        with self._present():
            if endpoint != CONTROL_OUT or endpoint in self._pipe.halted:
                raise Stalled("no such endpoint, or halted")
            try:
                self._control.receive(data)
            except Unplugged:
                self.unplug()
                raise

    def bulk_in(self, endpoint: int, length: int) -> bytes | memoryview | None:
        """What a bulk IN transfer of ``length`` bytes receives now; None when the camera has nothing to say yet.

        Raises:
            Stalled, Overflowed, Unplugged: as the bus does.
        """
        with self._present():
            if endpoint not in self._queues or endpoint in self._pipe.halted:
                raise Stalled("no such endpoint, or halted")
            if endpoint == STREAM_IN:
                self._acquisition.pump()
            try:
                return self._queues[endpoint].read(length, self.clock.now_ns())
            except Stalled:
                self._pipe.halted.add(endpoint)
                raise
            except Unplugged:
                self.unplug()
                raise

    def ready_ns(self, endpoint: int) -> int | None:
        """When ``bulk_in`` will have something; None when that depends on the host."""
        with self._present():
            waiting = self._queues[endpoint].ready_ns()
            if waiting is None and endpoint == STREAM_IN:
                return self._acquisition.next_frame_ns()
            return waiting

    def _power_on(self) -> None:
        model, packet = self.model, self.speed.packet_size
        manifest = manifest_of(model, self._injector.faults.description)
        self._memory = Memory(((at.MANIFEST, manifest.table), (at.DESCRIPTION, manifest.file)))
        bootstrap.fill(self._memory, model, self.speed)
        self._queues = {endpoint: BulkIn(packet) for endpoint in (CONTROL_IN, STREAM_IN)}
        if model.event_interface:
            self._queues[EVENT_IN] = BulkIn(packet)
        self._pipe = DefaultPipe(descriptors_of(model, self.speed))
        self._features = Features(model, self._memory, lambda: self._acquisition.running)
        streaming = self._queues[STREAM_IN]
        self._stream = StreamInterface(
            self._memory,
            model.alignment,
            lambda: self._features.payload_size,
            lambda: STREAM_IN in self._pipe.halted,
            streaming.clear,
        )
        parts = (self._memory, self._features, self._stream, streaming)
        self._acquisition = Acquisition(*parts, self._source, model.bits, self.clock, lambda: self._injector)
        server = GenCpServer(self._read, self._write, model.max_transfer)
        self._control = ControlChannel(server, self._queues[CONTROL_IN], self.clock, lambda: self._injector)
        self._rules = self._features.rules() | self._stream.rules() | self._acquisition.rules()
        self._rules |= {at.TIMESTAMP_LATCH: self._latch, at.EI_EVENT_TEST_CONTROL: self._test_event}

    def _read(self, address: int, length: int) -> bytes:
        self._memory.put_uint(at.PAYLOAD_SIZE, self._features.payload_size)
        self._memory.put_uint(at.SI_REQUIRED_PAYLOAD_SIZE, self._features.payload_size)
        return self._memory.read(address, length)

    def _write(self, address: int, data: bytes) -> None:
        for register in self._memory.writable(address, len(data)):
            start = register.address - address
            value = int.from_bytes(data[start : start + register.length], "little")
            rule = self._rules.get(register)
            self._memory.put_uint(register, value if rule is None else rule(value))

    def _latch(self, value: int) -> int:
        self._memory.put_uint(at.TIMESTAMP, self.clock.now_ns())
        return 0

    def _test_event(self, value: int) -> int:
        if EVENT_IN not in self._queues or not self._memory.uint(at.EI_CONTROL) & 1:
            raise Refused(Status.ACCESS_DENIED)
        body = struct.pack("<HHQ", 0, _TEST_EVENT, self.clock.now_ns())
        head = struct.pack("<IHHHH", _EVENT_PREFIX, 0, _EVENT_COMMAND, len(body), 0)
        self._queues[EVENT_IN].push(Message(head + body))
        return 0

    @contextmanager
    def _present(self) -> Iterator[None]:
        with self._lock:
            if not self.plugged:
                raise Unplugged("not in the port")
            yield
