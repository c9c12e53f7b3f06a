"""A camera that looks into a simulated world."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType
from typing import final

import numpy as np
from jaxtyping import Float

from udccal.cameras.protocol import CameraIdentity, Frame, Region, Settings
from udccal.errors import CameraError
from udccal.simulation.world import SimulatedWorld

_GAIN_DB = (0.0, 24.0)
_MIN_REGION = 2
_DEFAULT_EXPOSURE_S = 8e-3
# Frames are developed ahead on as many threads; their noise is seeded per frame, so that this changes nothing.
_THREADS = 2


@final
class SimulatedCamera:
    """Implements ``udccal.cameras.protocol.Camera`` on a simulated world."""

    def __init__(self, world: SimulatedWorld) -> None:
        camera = world.truth.description.camera
        self._world = world
        self._camera = camera
        self._open = False
        exposure = min(max(_DEFAULT_EXPOSURE_S, camera.min_exposure_s), camera.max_exposure_s)
        self._settings = Settings(exposure, 0.0, self.sensor)

    @property
    def identity(self) -> CameraIdentity:
        """Which simulated camera this is."""
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

    def __enter__(self) -> SimulatedCamera:
        self._open = True
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open = False

    def configure(self, settings: Settings) -> Settings:
        """Accept settings as they are.

        Raises:
            CameraError: when one is outside what the camera can do.
        """
        self._check_range("an exposure", settings.exposure_s, self._camera.min_exposure_s, self._camera.max_exposure_s)
        self._check_range("a gain", settings.gain_dB, *_GAIN_DB)
        self._check_region(settings.region)
        self._settings = settings
        return settings

    def frames(self, count: int) -> Iterator[Frame]:
        """Deliver ``count`` frames with the present settings and whatever is arranged when each is exposed.

        Raises:
            CameraError: when the camera is not open.
        """
        if not self._open:
            raise CameraError("Expected an open camera, found it closed. Use it in a 'with' statement.")
        return self._deliver(count)

    def _deliver(self, count: int) -> Iterator[Frame]:
        waiting: deque[Future[Frame]] = deque()
        with ThreadPoolExecutor(_THREADS) as pool:
            for _ in range(count):
                waiting.append(self._expose(pool))
                if len(waiting) > _THREADS:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()

    def _expose(self, pool: ThreadPoolExecutor) -> Future[Frame]:
        settings = self._settings
        period_s = max(1.0 / self._camera.frame_rate_hz, settings.exposure_s)
        frame_id, timestamp_s = self._world.next_frame(period_s)
        rate = self._world.rate_during(settings, timestamp_s)
        return pool.submit(self._develop, rate, settings, timestamp_s, frame_id)

    def _develop(
        self, rate: Float[np.ndarray, "rows columns"], settings: Settings, timestamp_s: float, frame_id: int
    ) -> Frame:
        data = self._world.develop(rate, settings, frame_id)
        return Frame(data, settings, timestamp_s, frame_id, complete=True)

    def _check_range(self, what: str, value: float, low: float, high: float) -> None:
        if not low <= value <= high:
            raise CameraError(f"Expected {what} from {low:g} to {high:g}, found {value:g}. Ask for one in that range.")

    def _check_region(self, region: Region) -> None:
        even = all(v % 2 == 0 for v in (region.x, region.y, region.columns, region.rows))
        starts = region.x >= 0 and region.y >= 0 and min(region.columns, region.rows) >= _MIN_REGION
        ends = region.x + region.columns <= self._camera.columns and region.y + region.rows <= self._camera.rows
        if not (even and starts and ends):
            raise CameraError(
                f"Expected a region on even coordinates inside {self._camera.columns} x {self._camera.rows} pixels, "
                f"found {region.columns} x {region.rows} at ({region.x}, {region.y}). Move or shrink it."
            )
