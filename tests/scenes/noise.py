"""A sensor whose noise is known, and its frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Float, UInt16

from udccal.fitting.noise.codes import NORMAL_SHAPE, tukey_lambda_std
from udccal.fitting.noise.data import ExposureLevel, NoiseData, SpatialStack
from udccal.fitting.noise.fit import fit_noise
from udccal.models.noise import Noise
from udccal.result import FitResult


@dataclass(frozen=True)
class ToySensor:
    """A sensor and how it is measured; noise is drawn in electrons, then K, row noise, rounding and clipping.

    ``other_noise`` draws read noise of unit variance in place of Tukey's lambda; a fraction ``telegraph`` of the pixels
    has three times the read noise. ``pattern`` is a relative response in addition to the white one, ``dark_pattern``
    the pixels' dark current over their mean. ``black_DN_per_s`` moves black with exposure, without noise; below 0 it
    compensates dark current. ``response`` maps a
    linear signal to one that is seen, both over the full well, and takes the place of ``bend``.
    """

    rows: int = 96
    columns: int = 128
    K_DN_per_e: float = 0.36
    black_DN: float = 64.0
    full_well_e: float = 10_000.0
    read_e: float = 4.0
    lambda_read: float | None = 0.05
    other_noise: Callable[[np.random.Generator, tuple[int, ...]], np.ndarray] | None = None
    telegraph: float = 0.0
    pattern: Float[np.ndarray, "rows columns"] | None = None
    dark_pattern: Float[np.ndarray, "rows columns"] | None = None
    row_DN: float = 0.4
    dark_e_per_s: float = 40.0
    black_DN_per_s: float = 0.0
    DSNU_e: float = 3.0
    PRNU: float = 0.008
    bend: float = 0.02
    response: Callable[[np.ndarray], np.ndarray] | None = None
    bits: int = 12
    flux_e_per_s: float = 50_000.0
    flicker: float = 0.0
    lamp: float = 1.0
    levels: tuple[float, ...] = (0.04, 0.12, 0.22, 0.32, 0.42, 0.52, 0.62, 0.72, 0.82, 1.4)
    dark_times_s: tuple[float, ...] = (0.01, 0.05, 0.1, 0.3, 0.6, 1.0)
    stack_level: float = 0.5
    stack_frames: int = 8

    @property
    def shape(self) -> float:
        """Of the read noise; None stands for normal noise."""
        return NORMAL_SHAPE if self.lambda_read is None else self.lambda_read

    def exposure_s(self, level: float) -> float:
        """Time that fills the well to this fraction."""
        return level * self.full_well_e / self.flux_e_per_s


@dataclass(frozen=True)
class Patterns:
    """What one sensor keeps from frame to frame."""

    response: Float[np.ndarray, "rows columns"]
    offset_e: Float[np.ndarray, "rows columns"]
    read_e: Float[np.ndarray, "rows columns"]


def patterns(sensor: ToySensor, rng: np.random.Generator) -> Patterns:
    """Fixed patterns of one sensor of this kind."""
    shape = (sensor.rows, sensor.columns)
    # Of exactly these deviations, as EMVA 1288's numbers are those of the sensor at hand.
    drawn = (rng.standard_normal(shape) for _ in range(2))
    white, uneven = ((one - one.mean()) / one.std() for one in drawn)
    response, offset = 1 + sensor.PRNU * white, sensor.DSNU_e * uneven
    response = response if sensor.pattern is None else response + sensor.pattern
    noisy = rng.random(shape) < sensor.telegraph if sensor.telegraph else np.zeros(shape, bool)
    return Patterns(response, offset, np.where(noisy, 3.0, 1.0) * sensor.read_e)


def expose(
    sensor: ToySensor, fixed: Patterns, exposure_s: float, lit: bool, rng: np.random.Generator
) -> UInt16[np.ndarray, "rows columns"]:
    """One frame."""
    shape = fixed.response.shape
    light = sensor.lamp * sensor.flux_e_per_s * (1 + sensor.flicker * rng.standard_normal()) if lit else 0.0
    dark = sensor.dark_e_per_s * (1.0 if sensor.dark_pattern is None else sensor.dark_pattern)
    mean = exposure_s * (np.maximum(light * fixed.response, 0.0) + dark)
    counts = rng.poisson(mean).astype(np.float64)
    bent = counts * (1 - sensor.bend * counts / sensor.full_well_e)
    if sensor.response is not None:
        bent = sensor.full_well_e * sensor.response(counts / sensor.full_well_e)
    bent = np.minimum(bent, sensor.full_well_e)
    draw = sensor.other_noise
    noise = draw(rng, shape) if draw else _read_noise(sensor.lambda_read, shape, rng)
    signal = bent + fixed.offset_e + fixed.read_e * noise
    black = sensor.black_DN + sensor.black_DN_per_s * exposure_s
    codes = black + sensor.K_DN_per_e * signal + sensor.row_DN * rng.standard_normal((shape[0], 1))
    return np.clip(np.rint(codes), 0, 2**sensor.bits - 1).astype(np.uint16)


def _read_noise(
    shape: float | None, size: tuple[int, ...], rng: np.random.Generator
) -> Float[np.ndarray, "rows columns"]:
    if shape is None:
        return rng.standard_normal(size)
    p = rng.random(size)
    return (p**shape - (1 - p) ** shape) / shape / tukey_lambda_std(shape)


def measure(sensor: ToySensor, seed: int) -> FitResult[Noise]:
    """Capture a new sensor of this kind and fit it through the public API."""
    return fit_noise(captured(sensor, seed))


def captured(sensor: ToySensor, seed: int) -> NoiseData:
    """Frames of a new sensor of this kind."""
    rng = np.random.default_rng([seed, 77])
    fixed = patterns(sensor, rng)
    shoot = partial(expose, sensor, fixed, rng=rng)
    levels = []
    for level in sensor.levels:
        t = sensor.exposure_s(level)
        levels.append(ExposureLevel(t, bright=(shoot(t, True), shoot(t, True))))
    levels += [ExposureLevel(t, dark=(shoot(t, False), shoot(t, False))) for t in sensor.dark_times_s]
    t = sensor.exposure_s(sensor.stack_level)
    dark, bright = ([shoot(t, lit) for _ in range(sensor.stack_frames)] for lit in (False, True))
    return NoiseData(levels, SpatialStack(t, dark, bright), top_code=2**sensor.bits - 1)


def truth(sensor: ToySensor) -> dict[str, float]:
    """The estimates' true values, by name."""
    full = min(sensor.black_DN + sensor.K_DN_per_e * sensor.full_well_e, 2.0**sensor.bits - 1)
    return {
        "K_DN_per_e": sensor.K_DN_per_e,
        "black_DN": sensor.black_DN,
        "saturation_DN": full,
        "sigma_d_e": float(np.hypot(sensor.read_e, sensor.row_DN / sensor.K_DN_per_e)),
        "lambda_read": sensor.shape,
        "sigma_row_DN": sensor.row_DN,
        "dark_current_e_per_s": sensor.dark_e_per_s,
        "DSNU1288_e": sensor.DSNU_e,
        "PRNU1288": sensor.PRNU,
        "nonlinearity": sensor.bend * (full - sensor.black_DN) / (sensor.K_DN_per_e * sensor.full_well_e),
    }


def right_orders(share: float) -> tuple[int, int]:
    """Of sensors with and without each term, how many were found to have just the terms they have; and of how many."""
    rng = np.random.default_rng(1)
    count, right = max(20, int(share * 100)), 0
    for seed in range(count):
        there = rng.random(5) < 0.5
        sensor = sensor_with(there)
        right += chosen_terms(measure(sensor, 10_000 + seed)) == tuple(there.tolist())
    return right, count


def sensor_with(there: np.ndarray) -> ToySensor:
    """The toy sensor with some of: row noise, dark current, DSNU, PRNU, curvature."""
    full = ToySensor()
    names = ("row_DN", "dark_e_per_s", "DSNU_e", "PRNU", "bend")
    return replace(full, **{name: 0.0 for name, here in zip(names, there, strict=True) if not here})


def chosen_terms(result: FitResult[Noise]) -> tuple[bool, ...]:
    """The same five, as the fit has them; another order of the light than steady and without offset counts as wrong."""
    chosen = [candidate.name for candidate in result.candidates if candidate.chosen]
    starts = ("with row", "with dark", "with DSNU", "with PRNU")
    curved = {"response: linear": (False,), "response: curved": (True,)}
    response = next(name for name in chosen if name.startswith("response"))
    return (*(any(name.startswith(start) for name in chosen) for start in starts), *curved.get(response, ()))


# Light enough to have no curvature to speak of; a shorter way than the efficiency bench's.
PLAIN = ToySensor(lambda_read=None, bend=0.0)


def errors_in_sigma(result: FitResult[Noise], sensor: ToySensor) -> Float[np.ndarray, " n"]:
    """Return z of every estimate that has a true value; one with sigma 0 must be right."""
    z = []
    for name, value in truth(sensor).items():
        found = next((item for item in result.estimates if item.name == name), None)
        if found is None:
            continue
        # What rounding leaves of the shape is known to its prior alone, and a saturation of codes is exact.
        z.append((found.value - value) / found.sigma if found.sigma > 0 else 1e6 * float(found.value != value))
    return np.array(z)


def capture(sensor: ToySensor, seed: int) -> tuple[list[ExposureLevel], SpatialStack]:
    """Frames of all levels, two of a kind, and a stack."""
    rng = np.random.default_rng(seed)
    shoot = partial(expose, sensor, patterns(sensor, rng), rng=rng)
    times = [sensor.exposure_s(level) for level in sensor.levels]
    levels = [ExposureLevel(t, (shoot(t, False), shoot(t, False)), (shoot(t, True), shoot(t, True))) for t in times]
    t = sensor.exposure_s(sensor.stack_level)
    dark, bright = ([shoot(t, lit) for _ in range(sensor.stack_frames)] for lit in (False, True))
    return levels, SpatialStack(t, dark, bright)
