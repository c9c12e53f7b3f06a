"""Merged brackets against the bound of one pixel's censored likelihood, decade by decade.

A pixel of few electrons has its sigma at its own noisy rate, so that z-scores of single pixels are skewed even for a
perfect merge. z uses the root mean square of the sigmas of one rate.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Array, Float

from tests.benchmarks.efficiency.trials import Trials, column
from tests.scenes.information import fisher_information
from udccal.fitting.engine.gaussian import cramer_rao
from udccal.fitting.hdr.merge import merge_bracket
from udccal.models.noise import Noise

_K, _BLACK, _TOP, _SIGMA = 0.36, 64.0, 4095.0, 4.0
_TIMES = 2.0 ** np.arange(10)
_DECADES = np.geomspace(8e-3, 8e3, 7)
# Of each decade: rates drawn within it, and pixels of one rate.
_RATES, _PIXELS = 100, 200


def sensor() -> Noise:
    """A 12-bit sensor that clips in its converter."""
    return Noise(_K, _BLACK, _TOP, _SIGMA, 0.14, 0.0, 1.0, 0.0, 0.0, 0.0)


def bracket(rates: Float[np.ndarray, " pixels"], seed: int) -> Float[np.ndarray, "n 1 pixels"]:
    """Codes of one row of pixels at all exposures, in whole numbers."""
    rng = np.random.default_rng(seed)
    electrons = rng.poisson(rates * _TIMES[:, None, None], (len(_TIMES), 1, len(rates)))
    noisy = electrons + _SIGMA * rng.standard_normal(electrons.shape)
    return np.clip(np.rint(_BLACK + _K * noisy), 0, _TOP)


def trials(share: float) -> list[Trials]:
    """One figure per decade of light, from a millionth of the brightest up."""
    # Half a decade up, the brightest light would clip in every exposure.
    count, found = max(10, round(share * _RATES)), []
    for seed, middle in enumerate(_DECADES):
        drawn = middle * 10 ** np.random.default_rng([seed, 0xD]).uniform(-0.5, 0.1, count)
        rates = np.repeat(drawn, _PIXELS)
        merged = merge_bracket(bracket(rates, seed).astype(np.uint16), _TIMES, sensor())
        informations = [fisher_information(_samples, np.array([rate]), _TIMES, clip=_TOP - 0.5) for rate in drawn]
        bound = np.repeat([float(cramer_rao(one)[0]) for one in informations], _PIXELS)
        pooled = np.sqrt((merged.sigma_e_per_s.reshape(count, _PIXELS) ** 2).mean(axis=1))
        error, sigma = merged.rate_e_per_s.ravel() - rates, np.repeat(pooled, _PIXELS)
        number = np.repeat(np.arange(count), _PIXELS)
        name = f"hdr/{middle:.0e} e-/s"
        found.append(column(name, error.tolist(), sigma.tolist(), bound.tolist(), number))
    return found


def _samples(x: Float[Array, "1"], times: Float[Array, " n"]) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    signal = x[0] * times
    return _BLACK + _K * signal, _K**2 * (signal + _SIGMA**2) + 1 / 12
