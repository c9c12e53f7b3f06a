"""The gain by the variance of flats from frame to frame."""

from __future__ import annotations

import numpy as np
import pytest

from tests.profiles.conftest import fitted
from udccal.drift.gain import gain_ratio
from udccal.models.noise import Noise
from udccal.result import Estimate, FitResult
from udccal.sessions.store import Average

K, BLACK, READ_E, FRAMES = 0.36, 64.0, 5.0, 10


@pytest.fixture(scope="module")
def result() -> FitResult[Noise]:
    noise = Noise(*(np.float64(v) for v in (K, BLACK, 4000.0, READ_E, 0.1, 0.0, 1.0, 0.0, 0.0, 0.0)))
    return fitted("noise", noise, (Estimate("K_DN_per_e", K, 2e-4, "DN/e"),))


def averaged(light_e: float, gain: float, seed: int) -> Average:
    """An average of frames, with a pixel that blinks."""
    rng = np.random.default_rng(seed)
    frames = gain * (rng.poisson(light_e, (FRAMES, 200, 300)) + READ_E * rng.normal(size=(FRAMES, 200, 300))) + BLACK
    frames[0, 7, 7] += 2000.0
    return Average(frames.mean(axis=0).astype(np.float32), frames.var(axis=0, ddof=1).astype(np.float32), FRAMES)


@pytest.mark.parametrize("more", [1.0, 1.02, 0.95])
def test_the_gain_is_found_within_its_error_bar(result: FitResult[Noise], more: float) -> None:
    found, sigma = gain_ratio(averaged(5000.0, more * K, 1), averaged(0.0, more * K, 2), result, "RGGB")
    assert sigma < 0.005
    assert abs(found - more) < 4 * sigma
