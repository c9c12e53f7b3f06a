"""The noise fit on many sensors of one kind, every frame drawn anew, against the bound of its own likelihood.

The sensor bends by two per cent, its read noise is heavy-tailed, and it has every other term of the model: so each of
the figures is of a term that is there.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt16

from tests.benchmarks.efficiency.trials import Trials, column
from udccal.fitting.engine.information import cramer_rao, fisher_information
from udccal.fitting.noise import ExposureLevel, NoiseData, NoiseRules, SpatialStack, codes, fit_noise
from udccal.fitting.noise.codes import NORMAL_SHAPE, excess_kurtosis, tukey_lambda_std
from udccal.fitting.noise.data import DarkPair, dark_pair
from udccal.fitting.noise.transfer import temporal_variance
from udccal.models.noise import Noise
from udccal.result import FitResult

_REALISATIONS = 1000


@dataclass(frozen=True)
class ToySensor:
    """A sensor and how it is measured; noise is drawn in electrons, then K, row noise, rounding and clipping."""

    rows: int = 96
    columns: int = 128
    K_DN_per_e: float = 0.36
    black_DN: float = 64.0
    full_well_e: float = 10_000.0
    read_e: float = 4.0
    lambda_read: float | None = 0.05
    row_DN: float = 0.4
    dark_e_per_s: float = 40.0
    DSNU_e: float = 3.0
    PRNU: float = 0.008
    bend: float = 0.02
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


def patterns(sensor: ToySensor, rng: np.random.Generator) -> Patterns:
    """Fixed patterns of one sensor of this kind."""
    shape = (sensor.rows, sensor.columns)
    return Patterns(1 + sensor.PRNU * rng.standard_normal(shape), sensor.DSNU_e * rng.standard_normal(shape))


def expose(
    sensor: ToySensor, fixed: Patterns, exposure_s: float, lit: bool, rng: np.random.Generator
) -> UInt16[np.ndarray, "rows columns"]:
    """One frame."""
    shape = fixed.response.shape
    light = sensor.lamp * sensor.flux_e_per_s * (1 + sensor.flicker * rng.standard_normal()) if lit else 0.0
    mean = exposure_s * (np.maximum(light * fixed.response, 0.0) + sensor.dark_e_per_s)
    counts = rng.poisson(mean).astype(np.float64)
    bent = np.minimum(counts * (1 - sensor.bend * counts / sensor.full_well_e), sensor.full_well_e)
    signal = bent + fixed.offset_e + sensor.read_e * _read_noise(sensor.lambda_read, shape, rng)
    codes = sensor.black_DN + sensor.K_DN_per_e * signal + sensor.row_DN * rng.standard_normal((shape[0], 1))
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
    return fit_noise(NoiseData(levels, SpatialStack(t, dark, bright), top_code=2**sensor.bits - 1))


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


# Parameters of the bound: K, V0, c, A, sigma_row^2, black, dark current, DSNU, PRNU, well (all DN), this sensor's mean
# offset, lambda.
_K, _V0, _BLACK, _RATE, _SPREAD, _SHAPE = 0, 1, 5, 6, 7, 11


def bounds(sensor: ToySensor) -> dict[str, float]:
    """Cramér–Rao bounds on the standard deviations of the estimates."""
    K, full = sensor.K_DN_per_e, sensor.K_DN_per_e * sensor.full_well_e
    x = np.array(
        [
            K,
            (K * sensor.read_e) ** 2,
            sensor.bend / full,
            K * sensor.flux_e_per_s,
            sensor.row_DN**2,
            sensor.black_DN,
            K * sensor.dark_e_per_s,
            (K * sensor.DSNU_e) ** 2,
            sensor.PRNU**2,
            full,
            0.0,
            sensor.shape,
        ]
    )
    information = fisher_information(partial(_statistics, sensor), x)
    information[np.ix_([_K, _V0, _SHAPE], [_K, _V0, _SHAPE])] += _histogram_information(sensor, x)
    with jax.enable_x64(True):
        slopes = np.asarray(jax.jacfwd(_quantities)(jnp.asarray(x)))
    return dict(zip(truth(sensor), cramer_rao(information, slopes).tolist(), strict=True))


def _quantities(x: Float[Array, "12"]) -> Float[Array, "10"]:
    K, V0, c, _, row2, black, rate, spread2, uneven2, full, _, shape = x
    values = [K, black, black + full, jnp.sqrt(V0 + row2) / K, shape, jnp.sqrt(row2), rate / K, jnp.sqrt(spread2) / K]
    return jnp.stack([*values, jnp.sqrt(uneven2), c * full])


def _statistics(sensor: ToySensor, x: Float[Array, "12"]) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Everything that the frames say, as means of independent normal numbers; their variances are taken for known."""
    K, V0, c, gain, row2, black, rate, spread2, uneven2, full, offset, shape = x
    pixels, frames = sensor.rows * sensor.columns, sensor.stack_frames
    stack_s = sensor.exposure_s(sensor.stack_level)
    parts: list[tuple[Array, Array]] = []

    def bright(t: float, count: int) -> None:
        z = (gain + rate) * t
        v = temporal_variance(z, K, V0, c, 1 / 12)
        parts.append((v, 2 * v**2 / (pixels * (count - 1))))
        # Above black as the darks tell it: that light grows from nothing with exposure is not trusted to tell black.
        parts.append((z - c * (z**2 + K * z), (v / pixels + row2 / sensor.rows) / count))

    for level in sensor.levels:
        if level < 0.9:
            bright(sensor.exposure_s(level), 2)
    bright(stack_s, frames)
    for t, count in [(t, 2) for t in sensor.dark_times_s] + [(stack_s, frames)]:
        v = V0 + 1 / 12 + K * rate * t
        parts.append((black + rate * t + offset, (v / pixels + row2 / sensor.rows) / count))
        row = row2 + v / sensor.columns
        parts.append((row, 2 * row**2 / (sensor.rows * (count - 1))))
        if count > 2:
            tails = excess_kurtosis(sensor.shape) * (V0 / v) ** 2
            parts.append((v, (2 + tails * (1 - 1 / count)) * v**2 / (pixels * (count - 1))))
    parts.append((offset, spread2 / pixels))
    averaged = spread2 + (V0 + 1 / 12 + K * rate * stack_s + row2) / frames
    parts.append((averaged, 2 * averaged**2 / pixels))
    z = (gain + rate) * stack_s
    quiet = V0 + 1 / 12 + K * rate * stack_s
    uneven = uneven2 + (temporal_variance(z, K, V0, c, 1 / 12) + quiet) / frames / (gain * stack_s) ** 2
    parts.append((uneven, 2 * uneven**2 / pixels))
    parts.append((black + full + offset, ((V0 + 1 / 12) / pixels + row2 / sensor.rows) / 2))
    # Nothing here tells of the shape.
    mean, variance = (jnp.stack(part) for part in zip(*parts, strict=True))
    return mean + 0.0 * shape, jax.lax.stop_gradient(variance)


def _histogram_information(sensor: ToySensor, x: Float[np.ndarray, "12"]) -> Float[np.ndarray, "3 3"]:
    """On gain, read variance and shape, of the joint histograms that are expected of the dark pairs.

    The gain is in it by the counts of dark current. Row noise is that of these very frames, and so known to them;
    black, dark current and offsets are left free: rows and pixels that pairs share tell less of them than it seems.
    """
    rng = np.random.default_rng(0)
    fixed = patterns(sensor, rng)
    places = [_K, _V0, _SHAPE, _BLACK, _RATE, _SPREAD]
    steps = np.diag([4e-3, 2e-3, 2e-3, 2e-3, 2e-3, 4e-3])
    information = np.zeros((6, 6))
    for t in sensor.dark_times_s:
        first, second = (expose(sensor, fixed, t, False, rng) for _ in range(2))
        # The information is expected, not observed: the counts matter by their number alone.
        pair = dark_pair(first, second, t, 1, 2**sensor.bits - 1)

        def probability(at: Float[np.ndarray, "6"], pair: DarkPair = pair) -> Float[np.ndarray, " cells"]:
            K, V0, shape, black, rate, spread2 = at
            known = codes.Surroundings(K, sensor.row_DN, NoiseRules().background)
            return codes.pair_probability(pair, np.array([black, rate, V0, spread2, shape]), known).ravel()

        p = probability(x[places])
        slopes = [(probability(x[places] + d) - probability(x[places] - d)) / (2 * d.sum()) for d in steps]
        information += pair.counts.sum() * (np.stack(slopes) / p) @ np.stack(slopes).T
    return np.linalg.inv(np.linalg.inv(information)[:3, :3])


def trials(share: float) -> list[Trials]:
    """A figure for each of the estimates."""
    sensor = ToySensor()
    count = max(40, int(share * _REALISATIONS))
    true, bound = truth(sensor), bounds(sensor)
    results = [measure(sensor, seed).or_raise() for seed in range(count)]
    found = []
    for name, value in true.items():
        estimates = [result.estimate(name) for result in results]
        errors, sigmas = [e.value - value for e in estimates], [e.sigma for e in estimates]
        found.append(column(f"noise/{name}", errors, sigmas, bound[name]))
    return found


def right_orders(share: float) -> tuple[int, int]:
    """Of sensors with and without each term, how many were found to have just the terms they have; and of how many."""
    rng = np.random.default_rng(1)
    count, right = max(20, int(share * 100)), 0
    for seed in range(count):
        there = rng.random(6) < 0.5
        sensor = sensor_with(there)
        right += chosen_terms(measure(sensor, 10_000 + seed)) == tuple(there.tolist())
    return right, count


def sensor_with(there: np.ndarray) -> ToySensor:
    """The toy sensor with some of: row noise, heavy tails, dark current, DSNU, PRNU, curvature."""
    full = ToySensor()
    return replace(
        full,
        row_DN=full.row_DN if there[0] else 0.0,
        lambda_read=full.lambda_read if there[1] else None,
        dark_e_per_s=full.dark_e_per_s if there[2] else 0.0,
        DSNU_e=full.DSNU_e if there[3] else 0.0,
        PRNU=full.PRNU if there[4] else 0.0,
        bend=full.bend if there[5] else 0.0,
    )


def chosen_terms(result: FitResult[Noise]) -> tuple[bool, ...]:
    """The same six, as the fit has them; another order of the light than steady and without offset counts as wrong."""
    chosen = [candidate.name for candidate in result.candidates if candidate.chosen]
    starts = ("with row", "with read", "with dark", "with DSNU", "with PRNU")
    curved = {"response: linear": (False,), "response: curved": (True,)}
    response = next(name for name in chosen if name.startswith("response"))
    return (*(any(name.startswith(start) for name in chosen) for start in starts), *curved.get(response, ()))
