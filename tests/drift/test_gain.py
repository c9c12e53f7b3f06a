"""The gain by the variance of flats from frame to frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.profiles.conftest import fitted
from udccal.drift.changes import gain_change
from udccal.drift.gain import GainRatio, gain_ratio
from udccal.drift.limits import DriftLimits
from udccal.models.noise import Noise
from udccal.result import Diagnostic, Estimate, FitResult
from udccal.sessions.store import Average

K, BLACK, READ_E, FRAMES = 0.36, 64.0, 5.0, 10


@pytest.fixture(scope="module")
def result() -> FitResult[Noise]:
    noise = Noise(*(np.float64(v) for v in (K, BLACK, 4000.0, READ_E, 0.1, 0.0, 1.0, 0.0, 0.0, 0.0)))
    return fitted("noise", noise, (Estimate("K_DN_per_e", K, 2e-4, "DN/e"),))


def averaged(light_e: float | np.ndarray, gain: float, seed: int, flicker: float = 0.0, cubic: float = 0.0) -> Average:
    """An average of frames, with a pixel that blinks."""
    rng = np.random.default_rng(seed)
    lamp = 1 + flicker * rng.normal(size=(FRAMES, 1, 1))
    electrons = rng.poisson(lamp * light_e, (FRAMES, 200, 300))
    frames = gain * (electrons + READ_E * rng.normal(size=electrons.shape))
    frames += BLACK - cubic * frames**3
    frames[0, 7, 7] += 2000.0
    return Average(frames.mean(axis=0).astype(np.float32), frames.var(axis=0, ddof=1).astype(np.float32), FRAMES)


@pytest.mark.parametrize("more", [1.0, 1.02, 0.95])
def test_the_gain_is_found_within_its_error_bar(result: FitResult[Noise], more: float) -> None:
    found = gain_ratio(averaged(5000.0, more * K, 1), averaged(0.0, more * K, 2), result, "RGGB")
    assert found.sigma < 0.005
    assert abs(found.value - more) < 4 * found.sigma
    assert found.flicker == 0.0  # light alike in all pixels does not tell


def test_the_gain_of_a_response_that_is_no_parabola_is_found(result: FitResult[Noise]) -> None:
    cubic, span = 5e-9, 4000.0 - BLACK
    bent = Estimate("nonlinearity", cubic * span**2, 1e-4, "1")
    estimates = (*result.estimates, bent)
    parabola = replace(result, estimates=estimates, cov=np.diag([one.sigma**2 for one in estimates]))
    own = replace(parabola, diagnostics=(Diagnostic("curvature_growth", cubic, "1/DN^2"),))
    flat, dark = averaged(5000.0, K, 1, cubic=cubic), averaged(0.0, K, 2)
    found, by_parabola = (gain_ratio(flat, dark, one, "RGGB") for one in (own, parabola))
    assert abs(found.value - 1) < 4 * found.sigma
    assert abs(by_parabola.value - 1) > 4 * by_parabola.sigma


def mosaic_e() -> np.ndarray:
    """Light that falls off to the corners, in three colours."""
    y, x = np.mgrid[-1:1:200j, -1:1:300j]
    return 9000.0 * (1 - 0.3 * (x**2 + y**2)) * np.tile([[0.6, 1.0], [1.0, 0.7]], (100, 150))


@pytest.mark.parametrize("seed", range(3))
def test_a_steady_lamp_shows_no_flicker(result: FitResult[Noise], seed: int) -> None:
    found = gain_ratio(averaged(mosaic_e(), 1.02 * K, seed), averaged(0.0, K, 9), result, "RGGB")
    assert (found.flicker, found.raised) == (0.0, 0.0)


def test_a_lamp_that_flickers_is_told(result: FitResult[Noise]) -> None:
    found = gain_ratio(averaged(mosaic_e(), K, 1, flicker=0.004), averaged(0.0, K, 2), result, "RGGB")
    assert found.value - 1 > 0.02  # the gain is that of the profile
    assert found.value - found.raised == pytest.approx(1.0, abs=0.01)
    assert found.flicker == pytest.approx(0.00265, rel=0.1)  # of these ten frames
    said = gain_change(found, DriftLimits()).what
    assert f"The lamp flickers by {100 * found.flicker:.2f} %" in said
    assert "flickers" not in gain_change(GainRatio(1.02, 0.001), DriftLimits()).what
