"""The noise fit on drawn sensors, each with new frames, against the bound of its own likelihood.

The sensor bends by two per cent, its read noise is heavy-tailed, and it has every other term of the model: so
each figure belongs to a term that is present.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tests.benchmarks.efficiency.trials import Trials, column
from tests.scenes.information import fisher_information
from tests.scenes.noise import ToySensor, expose, measure, patterns, truth
from udccal.fitting.engine.gaussian import cramer_rao
from udccal.fitting.noise.codes import DarkPair, dark_pair, excess_kurtosis, pair_probability
from udccal.fitting.noise.data import NoiseRules
from udccal.fitting.noise.response import temporal_variance

# Every sensor has so many realisations: its bound takes longer than they do.
_SENSORS, _REALISATIONS = 50, 20


# Parameters of the bound: K, V0, c, A, sigma_row^2, black, dark current, DSNU of pixels, PRNU, well (all DN), lambda,
# and the parts of DSNU by rows and by columns. The sensors have none, which a fit does not know.
_K, _V0, _BLACK, _RATE, _SPREAD, _SHAPE = 0, 1, 5, 6, 7, 10


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
            sensor.shape,
            0.0,
            0.0,
        ]
    )
    information = fisher_information(partial(_statistics, sensor), x)
    information[np.ix_([_K, _V0, _SHAPE], [_K, _V0, _SHAPE])] += _histogram_information(sensor, x)
    with jax.enable_x64(True):
        slopes = np.asarray(jax.jacfwd(_quantities)(jnp.asarray(x)))
    return dict(zip(truth(sensor), cramer_rao(information, slopes).tolist(), strict=True))


def _quantities(x: Float[Array, "13"]) -> Float[Array, "10"]:
    K, V0, c, _, row2, black, rate, spread2, uneven2, full, shape, by_row2, by_column2 = x
    offsets = jnp.sqrt(spread2 + by_row2 + by_column2)
    values = [K, black, black + full, jnp.sqrt(V0 + row2) / K, shape, jnp.sqrt(row2), rate / K, offsets / K]
    return jnp.stack([*values, jnp.sqrt(uneven2), c * full])


def _statistics(sensor: ToySensor, x: Float[Array, "13"]) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Everything that the frames say, as means of independent normal numbers; their variances are taken for known."""
    K, V0, c, gain, row2, black, rate, spread2, uneven2, full, shape, by_row2, by_column2 = x
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
        parts.append((black + rate * t, (v / pixels + row2 / sensor.rows) / count))
        row = row2 + v / sensor.columns
        parts.append((row, 2 * row**2 / (sensor.rows * (count - 1))))
        if count > 2:
            tails = excess_kurtosis(sensor.shape) * (V0 / v) ** 2
            parts.append((v, (2 + tails * (1 - 1 / count)) * v**2 / (pixels * (count - 1))))
    # The sensor at hand has these patterns; only what is temporal scatters.
    dark = (V0 + 1 / 12 + K * rate * stack_s) / frames
    for own, temporal, count in (
        (spread2, dark, pixels),
        (by_row2 + spread2 / sensor.columns, row2 / frames + dark / sensor.columns, sensor.rows),
        (by_column2 + spread2 / sensor.rows, dark / sensor.rows, sensor.columns),
    ):
        parts.append((own + temporal, 2 * ((own + temporal) ** 2 - own**2) / count))
    z = (gain + rate) * stack_s
    quiet = V0 + 1 / 12 + K * rate * stack_s
    uneven = uneven2 + (temporal_variance(z, K, V0, c, 1 / 12) + quiet) / frames / (gain * stack_s) ** 2
    parts.append((uneven, 2 * (uneven**2 - uneven2**2) / pixels))
    parts.append((black + full, ((V0 + 1 / 12) / pixels + row2 / sensor.rows) / 2))
    # Nothing here tells of the shape.
    mean, variance = (jnp.stack(part) for part in zip(*parts, strict=True))
    return mean + 0.0 * shape, jax.lax.stop_gradient(variance)


def _histogram_information(sensor: ToySensor, x: Float[np.ndarray, "11"]) -> Float[np.ndarray, "3 3"]:
    """Return the information on gain, read variance and shape in the expected joint histograms of the dark pairs.

    The counts of dark current carry information about the gain. Row noise is that of these frames, and so known. Black,
    dark current and offsets are free: rows and pixels are common to both frames of a pair and so less informative.
    """
    rng = np.random.default_rng(0)
    fixed = patterns(sensor, rng)
    places = [_K, _V0, _SHAPE, _BLACK, _RATE, _SPREAD]
    K, V0 = x[_K], x[_V0]
    steps = np.diag([0.01 * K, 1e-3 * V0, 2e-3, 1e-3 * V0**0.5, 1e-4 * x[_RATE], 3e-3 * x[_SPREAD]])
    information = np.zeros((6, 6))
    for t in sensor.dark_times_s:
        first, second = (expose(sensor, fixed, t, False, rng) for _ in range(2))
        # The information is expected, not observed: the counts matter by their number alone.
        pair = dark_pair(first, second, t, 1, 2**sensor.bits - 1)

        def probability(at: Float[np.ndarray, "6"], pair: DarkPair = pair) -> Float[np.ndarray, " cells"]:
            K, V0, shape, black, rate, spread2 = at
            values = np.array([black, rate, V0, spread2, shape])
            return pair_probability(pair, values, K, sensor.row_DN, NoiseRules().background).ravel()

        p = probability(x[places])
        slopes = [(probability(x[places] + d) - probability(x[places] - d)) / (2 * d.sum()) for d in steps]
        information += pair.counts.sum() * (np.stack(slopes) / p) @ np.stack(slopes).T
    return np.linalg.inv(np.linalg.inv(information)[:3, :3])


def trials(share: float) -> list[Trials]:
    """A figure for each of the estimates."""
    sensors = [drawn_sensor(seed) for seed in range(max(2, round(share * _SENSORS)))]
    number = np.repeat(np.arange(len(sensors)), _REALISATIONS)
    true, bound = [truth(sensor) for sensor in sensors], [bounds(sensor) for sensor in sensors]
    results = [measure(sensors[k], seed).or_raise() for seed, k in enumerate(number)]
    found = []
    for name in true[0]:
        estimates = [result.estimate(name) for result in results]
        errors = [e.value - true[k][name] for k, e in zip(number, estimates, strict=True)]
        sigmas, limits = [e.sigma for e in estimates], [bound[k][name] for k in number]
        found.append(column(f"noise/{name}", errors, sigmas, limits, number))
    return found


def drawn_sensor(seed: int) -> ToySensor:
    """A sensor on which every term of the model shows; exposures fill its well as they fill the plain one's."""
    rng = np.random.default_rng([seed, 0x5E])
    well_e = float(rng.uniform(8_000.0, 12_000.0))
    return ToySensor(
        K_DN_per_e=float(rng.uniform(0.28, 0.32)),
        black_DN=float(rng.uniform(50.0, 80.0)),
        full_well_e=well_e,
        read_e=float(rng.uniform(3.0, 6.0)),
        lambda_read=float(rng.uniform(0.03, 0.1)),
        row_DN=float(rng.uniform(0.25, 0.5)),
        dark_e_per_s=float(rng.uniform(20.0, 60.0)),
        DSNU_e=float(rng.uniform(2.0, 4.0)),
        PRNU=float(rng.uniform(0.005, 0.01)),
        bend=float(rng.uniform(0.01, 0.03)),
        flux_e_per_s=5 * well_e,
    )
