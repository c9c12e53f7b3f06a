"""Dark current that its noise tells otherwise than its mean: compensated by the camera, or a black that moves."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tests.scenes.noise import PLAIN, measure, truth


@pytest.mark.parametrize("dark_e_per_s", [5.0, 40.0])
@pytest.mark.parametrize("black_DN_per_s", [-3.0, -0.36 * 40, 3.0, 30.0])
def test_black_that_moves_with_exposure_is_told_and_sigma_d_holds(dark_e_per_s: float, black_DN_per_s: float) -> None:
    """sigma_d was 5 to 40 sigma off, dark current 44 to 360, in silence."""
    sensor = replace(PLAIN, dark_e_per_s=dark_e_per_s, black_DN_per_s=black_DN_per_s)
    result = measure(sensor, 3)
    (note,) = (one for one in result.notes if one.startswith("The noise of dark frames grows as that of "))
    by_noise = float(note.split("that of ")[1].split(" e/s")[0])
    assert by_noise == pytest.approx(dark_e_per_s, abs=2.5)
    for name in ("sigma_d_e", "K_DN_per_e", "dark_current_e_per_s", "lambda_read", "PRNU1288"):
        assert abs(result.estimate(name).value - truth(sensor)[name]) < 4 * result.estimate(name).sigma
    # The intercept of some exposures is less sure than the codes' fit, but not useless.
    assert result.estimate("sigma_d_e").sigma < 0.03 * sensor.read_e


@pytest.mark.parametrize("dark_e_per_s", [0.0, 5.0, 300.0])
@pytest.mark.parametrize("seed", range(3))
def test_dark_current_that_makes_its_own_noise_is_not_told(dark_e_per_s: float, seed: int) -> None:
    result = measure(replace(PLAIN, dark_e_per_s=dark_e_per_s), seed)
    assert not any("The noise of dark frames" in note for note in result.notes)
