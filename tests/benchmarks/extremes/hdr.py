"""Brackets at the ends: all too short, all clipped, seven decades, extreme gains, no dark noise, few bits."""

from __future__ import annotations

import functools

import equinox as eqx
import numpy as np

from tests.benchmarks.extremes.case import Case, Outcome
from udccal.fitting.hdr.merge import UNKNOWN_SIGMA, merge_bracket
from udccal.models.noise import Noise

_TIMES = 1e-4 * 4.0 ** np.arange(8)
_PIXELS, _GROUPS = 8000, 20


def _sensor(K: float = 0.36, sigma_d: float = 4.0, bits: int = 12, black: float = 64.0) -> Noise:
    return Noise(K, black, float(2**bits - 1), sigma_d, 0.14, 0.0, 1.0, 10.0, 0.0, 0.0)


def _merged(sensor: Noise, rates: tuple[float, float], times: np.ndarray = _TIMES) -> Outcome:
    """Pixels of rates spread evenly in the logarithm, evaluated in groups of similar rate.

    A pixel of few electrons has its sigma at its own noisy rate, so a group's root mean square is evaluated.
    """
    rate = np.geomspace(*rates, _PIXELS)
    rng = np.random.default_rng(5)
    electrons = rng.poisson((rate + 10.0) * times[:, None], (len(times), _PIXELS)) + float(
        np.asarray(sensor.sigma_d_e)
    ) * rng.standard_normal((len(times), _PIXELS))
    codes = np.rint(float(np.asarray(sensor.black_DN)) + float(np.asarray(sensor.K_DN_per_e)) * electrons)
    merged = merge_bracket(np.clip(codes, 0, sensor.saturation_DN).astype(np.uint16), times, sensor)
    finite = bool(np.isfinite(merged.rate_e_per_s).all() and np.isfinite(merged.sigma_e_per_s).all())
    if not merged.used.any():
        unknown = bool(np.all(merged.sigma_e_per_s == UNKNOWN_SIGMA))
        return Outcome(merged.status, np.zeros(0), finite, "every sigma says unknown" if unknown else "")
    error = (merged.rate_e_per_s - rate).reshape(_GROUPS, -1)
    sigma = np.sqrt(np.mean(merged.sigma_e_per_s.reshape(_GROUPS, -1) ** 2, axis=1, keepdims=True))
    z, size = error / sigma, error.shape[1]
    offsets, spreads = z.mean(axis=1), z.std(axis=1) - 1
    # In units of their own errors; offsets of less than a tenth of a pixel's sigma are within its error bars.
    off = np.where(np.abs(offsets) < 0.1, 0.0, offsets * np.sqrt(size))
    wide = np.where(np.abs(spreads) < 0.1, 0.0, spreads * np.sqrt(2 * size))
    return Outcome(merged.status, np.concatenate([off, wide]), finite, "")


def _case(name: str, sensor: Noise, rates: tuple[float, float], times: np.ndarray = _TIMES) -> Case:
    return Case("hdr", name, functools.partial(_merged, sensor, rates, times))


_NO_DARK_NOISE = eqx.tree_at(lambda n: n.sigma_d_e, _sensor(), 0.0)
CASES = (
    _case("dynamic range 10^2", _sensor(), (1e5, 1e7)),
    _case("dynamic range 10^7", _sensor(), (1e0, 1e7)),
    _case("all exposures too short", _sensor(), (1e-2, 1e0), _TIMES[:3]),
    _case("all exposures clipped", _sensor(), (1e9, 1e10)),
    _case("one exposure", _sensor(), (1e2, 5e3), _TIMES[-1:]),
    _case("twenty exposures", _sensor(), (1e1, 1e6), 1e-4 * 1.6 ** np.arange(20)),
    _case("gain 0.05 DN/e-", _sensor(K=0.05), (1e2, 1e7)),
    _case("gain 20 DN/e-", _sensor(K=20.0, bits=16), (1e1, 1e6)),
    _case("no dark noise", _NO_DARK_NOISE, (1e1, 1e7)),
    _case("8 bit", _sensor(K=0.02, bits=8, black=8.0), (1e3, 1e7)),
    _case("16 bit", _sensor(K=5.0, bits=16), (1e1, 1e7)),
)
