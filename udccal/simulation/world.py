"""A simulated rig with an arrangement in front of it, used by the simulated camera and display together."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import final

import numpy as np
from jaxtyping import Float, Float64, UInt16

from udccal.arrangements import Arrangement, Board, Dark, FlatLight, Led, Occasion, PanelPicture, Photograph
from udccal.cameras.protocol import Region, Settings
from udccal.simulation.disturbances import Disturbances, knock
from udccal.simulation.light import RigLight
from udccal.simulation.sensor import Sensor
from udccal.simulation.truth import RigTruth

_AIMING_ERROR_PX = 0.5
# Each step of a session has its own times and its own noise, so that the same steps give the same session however often
# it was interrupted. A step takes less than an hour and less than a million frames.
_STEP_S = 3600.0
_STEP_FRAMES = 1_000_000
_EPOCH = datetime(2000, 1, 1, tzinfo=UTC)


@dataclass(frozen=True)
class LedTruth:
    """The position that was asked of an LED, and the true position of its image (x, y in px)."""

    asked_px: tuple[float, float]
    image_px: tuple[float, float]
    disc_px: float


@dataclass(frozen=True)
class _Rendered:
    """Expected rates of an arrangement in a rectangle of the sensor."""

    of: Arrangement
    region: Region
    rate: Float64[np.ndarray, "rows columns"]


@final
class SimulatedWorld:
    """The rig, the arrangement in front of it, and the clock.

    Args:
        truth: the simulated rig.
        disturbances: disturbances of the measurement.
        seed: seed of noise and of aiming errors.
        led_support: (rows, columns) to either side of an LED's image within which its light is computed. The default
            is the size of the region that the psf procedure captures, so that the light covers the whole region.

    Attributes:
        sensor: the rig's sensor.
        truth_log: true positions of LEDs, for tests but not for fits.
    """

    def __init__(
        self,
        truth: RigTruth,
        disturbances: Disturbances | None = None,
        seed: int = 0,
        led_support: tuple[int, int] | None = None,
    ) -> None:
        captures, camera = truth.description.captures, truth.description.camera
        self.disturbances = disturbances or Disturbances()
        self.seed = seed
        self.sensor = Sensor(truth)
        self.truth_log: list[LedTruth] = []
        self.light = RigLight(truth)
        self._knocked = False
        self._whole = Region(0, 0, camera.columns, camera.rows)
        self._led_support = led_support or (captures.psf_region_rows, captures.psf_region_columns)
        self._led: LedTruth | None = None
        self._arrangement: Arrangement = Dark()
        self._rendered: _Rendered | None = None
        self._frames_begun = 0
        self._noise_from = 0
        self._clock_s = 0.0

    @property
    def truth(self) -> RigTruth:
        """The rig in its present state, which includes a knock that has happened."""
        return self.light.truth

    def arrange(self, arrangement: Arrangement, occasion: Occasion | None = None) -> None:
        """Replace the arrangement in front of the camera; an occasion sets the clock and the noise."""
        if occasion is not None:
            self._clock_s = (1 + occasion.number) * _STEP_S
            self._noise_from = (1 + occasion.number) * _STEP_FRAMES - self._frames_begun
        self._arrangement, self._led = arrangement, None
        if isinstance(arrangement, Led):
            self._led = self._aim(arrangement)
            self.truth_log.append(self._led)

    def now(self) -> datetime:
        """Return the simulated time of day."""
        return _EPOCH + timedelta(seconds=self._clock_s)

    def expected_rate(self, region: Region) -> Float64[np.ndarray, "rows columns"]:
        """Return expected photo-electrons per second in ``region``, before noise and flicker. Do not write to it."""
        # What is put back is not computed again: a person looks at it first, then has it captured.
        kept = self._rendered is not None and self._rendered.of is self._arrangement
        if self._rendered is None or not kept or not _covers(self._rendered.region, region):
            self._rendered = self._render(region)
        x, y = region.x - self._rendered.region.x, region.y - self._rendered.region.y
        rate = self._rendered.rate[y : y + region.rows, x : x + region.columns]
        if self.disturbances.smudge_fraction:
            rate = rate * self.disturbances.transmission(region.x, region.y, region.columns, region.rows)
        return rate + self.disturbances.leak_e_per_s if self.disturbances.leak_e_per_s else rate

    def next_frame(self, period_s: float) -> tuple[int, float]:
        """Start a frame and return its number and the time at which its exposure begins; lost frames are skipped."""
        while self.disturbances.drops(self._frames_begun):
            self._tick(period_s)
        frame_id, timestamp_s = self._frames_begun, self._clock_s
        if self.disturbances.knocked(frame_id) and not self._knocked:
            self._knock()
        self._tick(period_s)
        return frame_id, timestamp_s

    def rate_during(self, settings: Settings, timestamp_s: float) -> Float64[np.ndarray, "rows columns"]:
        """Return the expected rate of one frame in e-/s, flicker included."""
        rate = self.expected_rate(settings.region)
        if isinstance(self._arrangement, FlatLight) and self.disturbances.flicker_fraction:
            return rate * self.disturbances.flicker(timestamp_s, settings.exposure_s)
        return rate

    def develop(
        self, rate: Float[np.ndarray, "rows columns"], settings: Settings, frame_id: int
    ) -> UInt16[np.ndarray, "rows columns"]:
        """Convert light to a frame in DN; the frame's number seeds its noise, so that order does not matter."""
        index = self._noise_from + frame_id
        rng = np.random.Generator(np.random.SFC64(np.random.SeedSequence([self.seed, 0xF2A3E, index])))
        return self.sensor.expose(rate, settings.exposure_s, settings.region, rng, settings.gain_dB)

    def _tick(self, period_s: float) -> None:
        self._frames_begun += 1
        self._clock_s += period_s

    def _knock(self) -> None:
        self._knocked = True
        self.light = RigLight(knock(self.truth, self.disturbances.knock_mm))
        self._rendered = None

    def _aim(self, led: Led) -> LedTruth:
        """Aim the LED as a person would; the error depends on the place alone, so that a resumed session repeats it."""
        place = [round(1e3 * v) & 0xFFFFFFFF for v in (led.x_px, led.y_px)]
        error = np.random.default_rng([self.seed, 0xA13, *place]).uniform(-_AIMING_ERROR_PX, _AIMING_ERROR_PX, 2)
        image = (led.x_px + float(error[0]), led.y_px + float(error[1]))
        return LedTruth((led.x_px, led.y_px), image, self.light.led_disc_px(led))

    def _render(self, region: Region) -> _Rendered:
        arrangement = self._arrangement
        match arrangement:
            case Led():
                return _Rendered(arrangement, region, self._led_rate(arrangement, region))
            case Dark():
                rate = np.zeros((self._whole.rows, self._whole.columns))
            case FlatLight():
                rate = self.light.flat()
            case Board():
                rate = self.light.board(arrangement)
            case PanelPicture():
                rate = self.light.panel(arrangement.picture)
            case Photograph():
                rate = self.light.photograph(arrangement)
        rate.flags.writeable = False
        return _Rendered(arrangement, self._whole, rate)

    def _led_rate(self, led: Led, region: Region) -> Float64[np.ndarray, "rows columns"]:
        assert self._led is not None
        rate = np.zeros((region.rows, region.columns))
        lit = _lit_part(region, self._led.image_px, self._led_support)
        if lit is not None:
            x, y = lit.x - region.x, lit.y - region.y
            rate[y : y + lit.rows, x : x + lit.columns] = self.light.led(led, self._led.image_px, lit)
        rate.flags.writeable = False
        return rate


def _covers(outer: Region, inner: Region) -> bool:
    across = outer.x <= inner.x and inner.x + inner.columns <= outer.x + outer.columns
    return across and outer.y <= inner.y and inner.y + inner.rows <= outer.y + outer.rows


def _lit_part(region: Region, image_px: tuple[float, float], support: tuple[int, int]) -> Region | None:
    """Return the part of ``region`` within ``support`` (rows, columns) of an image, on even coordinates, or None."""
    left, right = (max(region.x, 2 * int((image_px[0] - support[1]) // 2)), region.x + region.columns)
    top, bottom = (max(region.y, 2 * int((image_px[1] - support[0]) // 2)), region.y + region.rows)
    right = min(right, 2 * int((image_px[0] + support[1]) // 2 + 1))
    bottom = min(bottom, 2 * int((image_px[1] + support[0]) // 2 + 1))
    return Region(left, top, right - left, bottom - top) if right > left and bottom > top else None
