"""Merged brackets against the bound of one pixel's censored likelihood, decade by decade.

A pixel of few electrons has its sigma at its own noisy rate, so that z-scores of single pixels are skewed even for a
perfect merge. z uses the root mean square of the sigmas.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Array, Float

from tests.benchmarks.efficiency.trials import Trials, column
from udccal.fitting.engine.information import cramer_rao, fisher_information
from udccal.fitting.hdr.merge import merge_bracket
from udccal.models.noise import Noise

_K, _BLACK, _TOP, _SIGMA = 0.36, 64.0, 4095.0, 4.0
_TIMES = 2.0 ** np.arange(10)
_DECADES = np.geomspace(8e-3, 8e3, 7)
_REALISATIONS = 20_000


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
    count = max(400, int(share * _REALISATIONS))
    found = []
    for seed, rate in enumerate(_DECADES):
        merged = merge_bracket(bracket(np.full(count, rate), seed).astype(np.uint16), _TIMES, sensor())
        information = fisher_information(_samples, np.array([rate]), _TIMES, clip=_TOP - 0.5)
        error = merged.rate_e_per_s.ravel() - rate
        sigma = np.full(count, np.sqrt(np.mean(merged.sigma_e_per_s**2)))
        found.append(column(f"hdr/{rate:.0e} e-/s", error.tolist(), sigma.tolist(), float(cramer_rao(information)[0])))
    return found


def _samples(x: Float[Array, "1"], times: Float[Array, " n"]) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    signal = x[0] * times
    return _BLACK + _K * signal, _K**2 * (signal + _SIGMA**2) + 1 / 12
