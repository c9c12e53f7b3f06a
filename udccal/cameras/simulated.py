"""A camera that looks into a simulated world."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from types import TracebackType
from typing import final

import numpy as np
from jaxtyping import Float

from udccal.cameras.checks import check_mode, check_settings, not_open, superseded
from udccal.cameras.faults import CameraFaults
from udccal.cameras.format_names import unpacked_format_name
from udccal.cameras.protocol import CameraIdentity, Counts, Features, Frame, Mode, Range, Region, Settings, Trigger
from udccal.errors import CameraLost, CameraTimeout
from udccal.simulation.world import SimulatedWorld

_GAIN_DB = Range(0.0, 24.0)
_SLOWEST_HZ = 0.01
_STEPS = (2, 2, 2, 2)
_DEFAULT_EXPOSURE_S = 8e-3
# Frames are computed ahead on this many threads; their noise is seeded per frame, so the number changes nothing.
_THREADS = 2
# The dark current of a simulated sensor is that of this temperature, and stays.
_TEMPERATURE_C = 35.0


@final
class SimulatedCamera:
    """Implements ``udccal.cameras.protocol.Camera`` on a simulated world; each frame advances its clock."""

    def __init__(self, world: SimulatedWorld, faults: CameraFaults | None = None) -> None:
        camera = world.truth.description.camera
        self._world = world
        self._camera = camera
        self._faults = faults or CameraFaults()
        self._open = False
        self._lost = False
        self._stream = 0
        self._counts = Counts()
        self._next_id: int | None = None
        self._handed_out = 0
        self._last: Frame | None = None
        exposure = min(max(_DEFAULT_EXPOSURE_S, camera.min_exposure_s), camera.max_exposure_s)
        self._settings = Settings(exposure, 0.0, self.sensor)
        self._mode = Mode(unpacked_format_name(camera.cfa, camera.bits))

    @property
    def identity(self) -> CameraIdentity:
        """Identity of the simulated camera."""
        return CameraIdentity("udccal", self._camera.model, f"simulated-{self._world.truth.seed}", "simulated")

    @property
    def sensor(self) -> Region:
        """The whole sensor."""
        return Region(0, 0, self._camera.columns, self._camera.rows)

    @property
    def cfa(self) -> str:
        """CFA pattern of the sensor's top-left 2 x 2."""
        return self._camera.cfa

    @property
    def bits(self) -> int:
        """Bits per sample."""
        return self._camera.bits

    @property
    def features(self) -> Features:
        """What the rig's camera can do; its one pixel format is that of the rig description."""
        camera = self._camera
        return Features(
            exposure_s=Range(camera.min_exposure_s, camera.max_exposure_s),
            gain_dB=_GAIN_DB,
            frame_rate_hz=Range(min(_SLOWEST_HZ, camera.frame_rate_hz), camera.frame_rate_hz),
            pixel_formats=(unpacked_format_name(camera.cfa, camera.bits),),
            triggers=(Trigger.FREE_RUN, Trigger.SOFTWARE),
            region_steps=_STEPS,
        )

    @property
    def mode(self) -> Mode:
        """Current mode."""
        return self._mode

    @property
    def counts(self) -> Counts:
        """Frames since the camera was opened; disturbances of the world and faults drop frames."""
        return self._counts

    def __enter__(self) -> SimulatedCamera:
        self._open, self._lost = True, False
        self._counts, self._next_id, self._last = Counts(), None, None
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open = False
        self._stream += 1

    def set_mode(self, mode: Mode) -> Mode:
        """Accept a mode as it is; the frame rate sets the pace of the simulated clock only.

        Raises:
            CameraError: when the camera does not have it, or is closed or gone.
        """
        self._check_open()
        check_mode(mode, self.features)
        self._mode = mode
        self._stream += 1
        return mode

    def configure(self, settings: Settings) -> Settings:
        """Accept settings as they are.

        Raises:
            CameraError: when one is outside what the camera can do, or the camera is closed or gone.
        """
        self._check_open()
        check_settings(settings, self.features, self.sensor)
        self._settings = settings
        self._stream += 1
        return settings

    def frames(self, count: int) -> Iterator[Frame]:
        """Deliver ``count`` frames with the current settings and the arrangement at the time of each exposure.

        A free-running camera exposes frames ahead of the delivered one; with the software trigger it exposes none.

        Raises:
            CameraError: when the camera is not open, or the stream was closed.
            CameraTimeout, CameraLost: as the faults define.
        """
        self._check_open()
        self._stream += 1
        return self._deliver(count, self._stream)

    def _check_open(self) -> None:
        if self._lost:
            raise CameraLost("Expected the simulated camera, found it unplugged. Plug it in and open it again.")
        if not self._open:
            raise not_open()

    def _deliver(self, count: int, stream: int) -> Iterator[Frame]:
        waiting: deque[Future[Frame]] = deque()
        ahead = 0 if self._mode.trigger is Trigger.SOFTWARE else _THREADS
        with ThreadPoolExecutor(_THREADS) as pool:
            for left in range(count, 0, -1):
                if self._stream != stream:
                    raise superseded()
                while len(waiting) < min(ahead + 1, left):
                    waiting.append(self._expose(pool))
                yield self._hand_out(waiting.popleft())

    def _expose(self, pool: ThreadPoolExecutor) -> Future[Frame]:
        settings = self._settings
        rate_hz = self._mode.frame_rate_hz or self._camera.frame_rate_hz
        frame_id, timestamp_s = self._world.next_frame(max(1.0 / rate_hz, settings.exposure_s))
        if self._next_id is not None:
            self._count(dropped=frame_id - self._next_id)
        self._next_id = frame_id + 1
        rate = self._world.rate_during(settings, timestamp_s)
        return pool.submit(self._develop, rate, settings, timestamp_s, frame_id)

    def _develop(
        self, rate: Float[np.ndarray, "rows columns"], settings: Settings, timestamp_s: float, frame_id: int
    ) -> Frame:
        data = self._world.develop(rate, settings, frame_id)
        return Frame(data, settings, timestamp_s, frame_id, complete=True, temperature_C=_TEMPERATURE_C)

    def _hand_out(self, developed: Future[Frame]) -> Frame:
        """Return the frame after the faults of the link."""
        number, self._handed_out = self._handed_out, self._handed_out + 1
        faults = self._faults
        if number == faults.unplug_at_frame:
            self._lost = True
            self._check_open()
        if number == faults.time_out_at_frame:
            self._count(dropped=1)
            raise CameraTimeout(f"Expected frame {number} of the simulated camera, found none in time. Ask again.")
        frame = developed.result()
        if faults.repeats(number) and self._last is not None:
            self._count(dropped=1)
            frame = replace(self._last, data=self._last.data.copy())
        elif faults.cuts(number):
            frame = _cut(frame)
        self._count(delivered=1, incomplete=0 if frame.complete else 1)
        if faults.repeat_every:
            self._last = replace(frame, data=frame.data.copy())
        return frame

    def _count(self, delivered: int = 0, incomplete: int = 0, dropped: int = 0) -> None:
        counts = self._counts
        self._counts = Counts(counts.delivered + delivered, counts.incomplete + incomplete, counts.dropped + dropped)


def _cut(frame: Frame) -> Frame:
    """Return the frame without its lower half."""
    data = frame.data.copy()
    data[len(data) // 2 :] = 0
    return replace(frame, data=data, complete=False)
