"""The merge of brackets: unbiased in the dark, honest about its sigma, blind to saturated samples."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import numpy as np
import pytest

from tests.scenes.brackets import EXPOSURES, NOISE, bracket
from udccal.errors import FitError
from udccal.fitting.hdr.likelihood import HdrRules, SensorNumbers, merge_block
from udccal.fitting.hdr.merge import UNKNOWN_SIGMA, merge_bracket
from udccal.models.noise import Noise
from udccal.result import FitStatus


@pytest.mark.parametrize("rate", [0.0, 5.0, 100.0, 3e3, 1e5, 3e6, 5e7])
@pytest.mark.medium
def test_unbiased_and_honest_over_seven_decades(rate: float) -> None:
    merge = merge_bracket(bracket(rate, EXPOSURES, 1), EXPOSURES, NOISE)
    error = merge.rate_e_per_s - rate
    # 14400 pixels: the mean is known to 0.8 % of the spread.
    assert abs(error.mean()) < 0.035 * error.std()
    assert error.std() == pytest.approx(np.sqrt(np.mean(merge.sigma_e_per_s**2)), rel=0.05)
    assert merge.used.min() >= 1


@pytest.mark.parametrize("brightness", [0.98, 0.99, 1.0, 1.01, 1.02])
def test_light_at_the_edge_of_clipping_is_not_overestimated(brightness: float) -> None:
    # Draws of the long exposure that come out low are measured well, high ones by the short exposure alone: the
    # likeliest rate is a third of a sigma too high.
    times = np.array([1e-3, 6e-3])
    level_e = (NOISE.saturation_DN - NOISE.black_DN) / NOISE.K_DN_per_e - 6 * NOISE.sigma_d_e
    rate = brightness * float(level_e) / times[1]
    merge = merge_bracket(bracket(rate, times, 21), times, NOISE)
    error, sigma = merge.rate_e_per_s - rate, np.sqrt(np.mean(merge.sigma_e_per_s**2))
    assert abs(error.mean()) < 0.1 * sigma
    # Sigma holds for brighter light, too, that the short exposure drew as low.
    assert 0.7 * sigma < error.std() < 1.15 * sigma


@pytest.mark.parametrize("ratio", [16.0, 64.0, 512.0])
def test_sigma_holds_near_the_clipping_of_a_far_longer_exposure(ratio: float) -> None:
    # A low draw of the short exposure lies below the level that the long one says is passed.
    times, level_e = np.array([1.0 / ratio, 1.0]), (NOISE.saturation_DN - NOISE.black_DN) / NOISE.K_DN_per_e
    rate = np.linspace(0.9, 1.4, 14_400).reshape(120, 120) * float(level_e)
    merge = merge_bracket(bracket(rate, times, 22), times, NOISE)
    z = (merge.rate_e_per_s - rate) / merge.sigma_e_per_s
    assert np.sum(np.abs(z) > 4.5) <= 3
    assert 0.8 < z.std() < 1.1


def test_light_within_two_codes_of_black_is_told_where_the_noise_smears_no_code() -> None:
    # 1 e- of dark noise is a fiftieth of a code: all samples of a pixel are rounded alike.
    coarse = replace(NOISE, K_DN_per_e=np.float64(0.02), sigma_d_e=np.float64(1.0), saturation_DN=np.float64(250.0))
    frames, longest = np.full((3, 8, 8), 66, np.uint16), 0.5
    times = np.array([0.1, longest, 1e-3])
    assert merge_bracket(frames, times, coarse).rounded_below == pytest.approx(2.0 / 0.02 / longest)
    # 4.5 e- are 1.6 codes.
    assert merge_bracket(frames, times, NOISE).rounded_below == 0.0


@pytest.mark.parametrize("times", [np.array([0.05]), 1e-3 * 3.0 ** np.arange(5)], ids=["one exposure", "five"])
def test_dark_pixels_of_a_quiet_sensor_lie_within_their_sigma(times: np.ndarray) -> None:
    # One electron per exposure: many pixels come out below zero, where the weights know too much.
    rng, rate = np.random.default_rng(3), 20.0
    electrons = [rng.poisson(rate * t, (200, 200)) + 1.5 * rng.standard_normal((200, 200)) for t in times]
    codes = np.clip(np.rint(64.0 + np.array(electrons)), 0, 4095).astype(np.uint16)
    quiet = Noise(1.0, 64.0, 4095.0, 1.5, 0.1, 0.0, 1.0, 0.0, 0.0, 0.0)
    merge = merge_bracket(codes, times, quiet)
    z = (merge.rate_e_per_s - rate) / merge.sigma_e_per_s
    assert np.mean(np.abs(z) > 4.5) < 1e-3
    assert z.std() == pytest.approx(1.0, abs=0.1)


@pytest.mark.medium
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
    assert merge.status is FitStatus.SATURATED
    assert merge.notes == ("16 of 16 pixels have no sample that could be used.",)


def test_some_saturated_pixels_are_counted_and_the_rest_is_merged() -> None:
    frames = bracket(1e4, EXPOSURES, 12, (4, 4))
    frames[:, 1, 2] = 4095
    merge = merge_bracket(frames, EXPOSURES, NOISE)
    assert merge.status is FitStatus.CONVERGED
    assert merge.notes == ("1 of 16 pixels have no sample that could be used.",)
    assert merge_bracket(frames[:, 2:], EXPOSURES, NOISE).notes == ()


def test_rules_decide_what_is_left_out() -> None:
    frames = bracket(2e3, EXPOSURES, 8, (30, 40))
    frames[6, 3, 5] = 3000
    assert merge_bracket(frames, EXPOSURES, NOISE).outliers
    assert not merge_bracket(frames, EXPOSURES, NOISE, HdrRules(believed_sigma=1e4)).outliers


@pytest.mark.medium
def test_level_near_saturation_is_not_pulled_down() -> None:
    # The longest exposure lies right at the limit: half its samples are above.
    rate = (3960.0 - 64.3) / 0.355 / EXPOSURES[3] * 0.998
    merge = merge_bracket(bracket(rate, EXPOSURES[:4], 5), EXPOSURES[:4], NOISE)
    error = merge.rate_e_per_s - rate
    assert abs(error.mean()) < 0.1 * np.sqrt(np.mean(merge.sigma_e_per_s**2))


def test_colour_planes_and_one_row_are_pictures_too() -> None:
    frames = bracket(1e4, EXPOSURES, 6, (8, 9))
    whole = merge_bracket(np.stack([frames] * 3, axis=-1), EXPOSURES, NOISE)
    row = merge_bracket(frames.reshape(7, 72), EXPOSURES, NOISE)
    np.testing.assert_array_equal(whole.rate_e_per_s[..., 1].ravel(), row.rate_e_per_s)


@pytest.mark.parametrize(
    "times", [EXPOSURES[:3], -EXPOSURES, EXPOSURES * np.nan, EXPOSURES * 1e-300, EXPOSURES * 1e300]
)
def test_exposures_that_cannot_be_are_refused(times: np.ndarray) -> None:
    with pytest.raises(FitError, match="positive exposure"):
        merge_bracket(bracket(10.0, EXPOSURES, 7, (4, 4)), times, NOISE)


def test_masked_codes_and_exposures_are_refused() -> None:
    """What lies under a mask was merged as if nobody had masked it."""
    codes = bracket(10.0, EXPOSURES, 7, (4, 4))
    with pytest.raises(FitError, match="Expected frames without masked entries, found 1 of"):
        merge_bracket(np.ma.masked_array(codes, np.arange(codes.size).reshape(codes.shape) == 3), EXPOSURES, NOISE)
    with pytest.raises(FitError, match="Expected exposures without masked entries, found 1 of"):
        merge_bracket(codes, np.ma.masked_equal(EXPOSURES, EXPOSURES[0]), NOISE)


@pytest.mark.usefixtures("as_other_programs_call")
@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"exposures_s": EXPOSURES + 1j}, "positive exposure"),
        ({"exposures_s": EXPOSURES.astype(str)}, "positive exposure"),
        ({"noise": "a"}, "a noise model whose K_DN_per_e is a number"),
        ({"rules": {}}, "Expected a HdrRules, found dict"),
    ],
)
def test_arguments_of_another_kind_are_refused(change: dict[str, Any], words: str) -> None:
    right = {"frames": bracket(10.0, EXPOSURES, 7, (4, 4)), "exposures_s": EXPOSURES, "noise": NOISE}
    with pytest.raises(FitError, match=words):
        merge_bracket(**right | change)


def test_a_hit_is_left_out_and_listed() -> None:
    rate = 2e3
    frames = bracket(rate, EXPOSURES, 8, (30, 40))
    frames[6, 3, 5] = 3000
    frames[5, 10, 20] = 4095
    merge = merge_bracket(frames, EXPOSURES, NOISE)
    (found,) = merge.outliers
    assert found.count == 2
    assert set(found.places) == {"(3, 5)", "(10, 20)"}
    for place in ((3, 5), (10, 20)):
        assert abs(merge.rate_e_per_s[place] - rate) < 5 * merge.sigma_e_per_s[place]
    assert merge.sigma_e_per_s[3, 5] > 1.5 * np.median(merge.sigma_e_per_s)


def test_single_precision_moves_no_rate_by_a_hundredth_of_its_sigma() -> None:
    frames = np.concatenate([bracket(rate, EXPOSURES, 11, (20, 20)) for rate in (0.0, 30.0, 1e3, 1e5, 1e7)], axis=1)
    merge = merge_bracket(frames, EXPOSURES, NOISE)
    numbers = jax.tree.map(np.float64, SensorNumbers.of(NOISE, float(EXPOSURES.max()), HdrRules()))
    codes = frames.reshape(7, -1)
    double = merge_block(codes, EXPOSURES / EXPOSURES.max(), numbers, np.zeros(codes.shape, bool), 6.0)
    assert double.rate.dtype == np.float64
    off = merge.rate_e_per_s.ravel() - double.rate / EXPOSURES.max()
    assert np.abs(off / merge.sigma_e_per_s.ravel()).max() < 0.01


def test_large_pictures_are_merged_like_small_ones() -> None:
    # The compiled pass takes large pictures in blocks; the last block overlaps the one before it.
    frames = bracket(1e4, EXPOSURES, 13, (300, 250))
    frames[6, 3, 5] = frames[6, 299, 249] = 100
    whole, part = merge_bracket(frames, EXPOSURES, NOISE), merge_bracket(frames[:, 200:], EXPOSURES, NOISE)
    off = (whole.rate_e_per_s[200:] - part.rate_e_per_s) / part.sigma_e_per_s
    assert np.abs(off).max() < 0.01
    np.testing.assert_array_equal(whole.used[200:], part.used)
    assert set(whole.outliers[0].places) == {"(3, 5)", "(299, 249)"}


def test_few_electrons_are_no_hits() -> None:
    """A quiet sensor with a coarse gain, in the dim: counts of one or two electrons are no hits."""
    noise = replace(NOISE, K_DN_per_e=2.0, sigma_d_e=1.0, dark_current_e_per_s=0.0, black_DN=64.0)
    rng = np.random.default_rng(6)
    rate = np.exp(rng.uniform(np.log(1e2), np.log(1e4), (300, 400)))
    electrons = [rng.poisson(rate * t) + rng.standard_normal(rate.shape) for t in EXPOSURES]
    frames = np.clip(np.rint(64 + 2.0 * np.array(electrons)), 0, 4095).astype(np.uint16)
    assert not merge_bracket(frames, EXPOSURES, noise).outliers
    frames[4, 7, 9] += 400
    (found,) = merge_bracket(frames, EXPOSURES, noise).outliers
    assert found.places == ("(7, 9)",)


def test_light_that_every_exposure_clips_is_no_hit() -> None:
    rate = np.full((8, 8), 3e4)
    rate[2, 3] = 1e9
    frames = bracket(rate, EXPOSURES, 4, (8, 8))
    merged = merge_bracket(frames, EXPOSURES, NOISE)
    assert not merged.outliers
    assert merged.used[2, 3] == 0
