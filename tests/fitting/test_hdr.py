"""The merge of brackets: unbiased in the dark, honest about its sigma, blind to saturated samples."""

from __future__ import annotations

import numpy as np
import pytest

from udccal.fitting.hdr import UNKNOWN_SIGMA, merge_bracket
from udccal.models.noise import Noise

NOISE = Noise(
    K_DN_per_e=0.355,
    black_DN=64.3,
    saturation_DN=3960.0,
    sigma_d_e=4.5,
    lambda_read=0.1,
    sigma_row_DN=0.0,
    q_DN=1.0,
    dark_current_e_per_s=20.0,
    DSNU1288_e=0.0,
    PRNU1288=0.0,
)
EXPOSURES = 1e-4 * 4.0 ** np.arange(7)


def bracket(rate: float, exposures: np.ndarray, seed: int, shape: tuple[int, int] = (120, 120)) -> np.ndarray:
    rng = np.random.default_rng(seed)
    electrons = [
        np.minimum(rng.poisson((rate + 20.0) * t, shape), (3960.0 - 64.3) / 0.355) + 4.5 * rng.standard_normal(shape)
        for t in exposures
    ]
    return np.clip(np.rint(64.3 + 0.355 * np.array(electrons)), 0, 4095).astype(np.uint16)


@pytest.mark.parametrize("rate", [0.0, 5.0, 100.0, 3e3, 1e5, 3e6, 5e7])
def test_unbiased_and_honest_over_seven_decades(rate: float) -> None:
    merge = merge_bracket(bracket(rate, EXPOSURES, 1), EXPOSURES, NOISE)
    error = merge.rate_e_per_s - rate
    # 14400 pixels: the mean is known to 0.8 % of the spread.
    assert abs(error.mean()) < 0.035 * error.std()
    assert error.std() == pytest.approx(np.sqrt(np.mean(merge.sigma_e_per_s**2)), rel=0.05)
    assert merge.used.min() >= 1


def test_repeats_lower_sigma_as_they_should() -> None:
    one = merge_bracket(bracket(1e3, EXPOSURES[-1:], 2), EXPOSURES[-1:], NOISE)
    repeated = np.repeat(EXPOSURES[-1:], 9)
    nine = merge_bracket(bracket(1e3, repeated, 3), repeated, NOISE)
    assert nine.sigma_e_per_s.mean() == pytest.approx(one.sigma_e_per_s.mean() / 3, rel=0.02)
    assert np.all(nine.used == 9)


def test_saturated_samples_are_left_out() -> None:
    merge = merge_bracket(bracket(1e6, EXPOSURES, 4), EXPOSURES, NOISE)
    clipped = (1e6 + 20) * EXPOSURES > (3960 - 64.3) / 0.355
    assert merge.used.max() <= np.count_nonzero(~clipped)
    naive = bracket(1e6, EXPOSURES, 4).astype(float)
    biased = ((naive - 64.3) / 0.355).sum(axis=0) / EXPOSURES.sum()
    assert abs(merge.rate_e_per_s.mean() / 1e6 - 1) < 0.002 < abs(biased.mean() / 1e6 - 1)


def test_a_pixel_saturated_everywhere_is_marked_and_finite() -> None:
    merge = merge_bracket(np.full((3, 4, 4), 4095, np.uint16), EXPOSURES[:3], NOISE)
    assert np.all(merge.used == 0)
    assert np.all(merge.rate_e_per_s == 0)
    assert np.all(merge.sigma_e_per_s == UNKNOWN_SIGMA)


def test_level_near_saturation_is_not_pulled_down() -> None:
    # The longest exposure lies right at the limit: half its samples are above.
    rate = (3960.0 - 64.3) / 0.355 / EXPOSURES[3] * 0.998
    merge = merge_bracket(bracket(rate, EXPOSURES[:4], 5), EXPOSURES[:4], NOISE)
    z = (merge.rate_e_per_s - rate) / merge.sigma_e_per_s
    assert abs(z.mean()) < 0.1
