"""What the merge of brackets says of a noise model, of times and of frames that are wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.scenes.brackets import EXPOSURES, NOISE, bracket
from tests.scenes.unchecked import unchecked
from udccal.errors import FitError
from udccal.fitting.hdr.merge import HdrMerge, merge_bracket
from udccal.fitting.psf.data import PsfData
from udccal.fitting.psf.fit import _notes as psf_notes
from udccal.models.noise import Noise
from udccal.result import FitStatus


def test_a_stream_that_is_stuck_is_named_and_a_picture_without_pixels_refused() -> None:
    stuck = merge_bracket(np.full((7, 12, 12), 64, np.uint16), EXPOSURES, NOISE)
    assert stuck.status is FitStatus.POOR_FIT
    assert "frame 0 have the code 64, where noise is expected: the stream is stuck (7 of 7 frames)" in stuck.notes[0]
    with pytest.raises(FitError, match="frames with pixels"):
        merge_bracket(np.zeros((7, 0, 12), np.uint16), EXPOSURES, NOISE)


def test_a_frame_of_other_light_is_left_out_and_listed() -> None:
    rates = np.geomspace(1e2, 1e5, 4000).reshape(40, 100)
    rng = np.random.default_rng(9)
    light = np.where(np.arange(7)[:, None, None] == 3, 0.9, 1.0) * rates * EXPOSURES[:, None, None]
    electrons = np.minimum(rng.poisson(light + 20.0 * EXPOSURES[:, None, None]), 10973)
    frames = np.clip(np.rint(64.3 + 0.355 * (electrons + 4.5 * rng.standard_normal(light.shape))), 0, 4095)
    merge = merge_bracket(frames.astype(np.uint16), EXPOSURES, NOISE)
    assert [o.places for o in merge.outliers] == [("frame 3",)]
    z = (merge.rate_e_per_s - rates) / merge.sigma_e_per_s
    assert abs(z.mean()) < 0.06
    assert z.std() == pytest.approx(1.0, abs=0.05)


def test_a_wrong_noise_model_is_told_by_the_scatter() -> None:
    rng = np.random.default_rng(5)
    for rate in (1e4, 1e5, 1e6):
        frames = bracket(rate, EXPOSURES, int(rng.integers(1000)))
        assert merge_bracket(frames, EXPOSURES, NOISE).status is FitStatus.CONVERGED
        for K in (0.8, 1.2):
            wrong = merge_bracket(frames, EXPOSURES, replace(NOISE, K_DN_per_e=K * 0.355))
            assert wrong.status is FitStatus.POOR_FIT
            assert "Check K" in wrong.notes[-1]


@pytest.mark.parametrize(
    ("K", "sigma_d_e", "bits"), [(0.05, 4.0, 12), (20.0, 4.0, 16), (0.36, 0.0, 12), (0.02, 4.0, 8)]
)
def test_codes_far_from_the_noise_are_no_doubt(K: float, sigma_d_e: float, bits: int) -> None:
    """Dark samples that rounding moves alike, or that code 0 cuts off, scatter less than their noise."""
    black, top, times = 64.0 if bits > 8 else 8.0, 2**bits - 1, 1e-4 * 4.0 ** np.arange(8)
    noise = replace(NOISE, K_DN_per_e=K, black_DN=black, saturation_DN=float(top), sigma_d_e=sigma_d_e)
    rng, rate = np.random.default_rng(8), np.geomspace(1e1, 1e7, 8000)
    light = rng.poisson((rate + 20.0) * times[:, None]) + sigma_d_e * rng.standard_normal((8, 8000))
    frames = np.clip(np.rint(black + K * light), 0, top).astype(np.uint16)
    merged = merge_bracket(frames, times, noise)
    assert merged.status is FitStatus.CONVERGED, merged.notes
    wrong = merge_bracket(frames, times, replace(noise, K_DN_per_e=1.2 * K))
    assert wrong.status is FitStatus.POOR_FIT
    assert "Check K" in " ".join(wrong.notes)


@pytest.mark.parametrize("exposures", [EXPOSURES, np.repeat(EXPOSURES[-1:], 5)], ids=["bracket", "repeats"])
def test_offsets_of_pixels_are_in_sigma_and_no_doubt(exposures: np.ndarray) -> None:
    offsets_e = 4.0 * np.random.default_rng(61).standard_normal((120, 120))
    frames = bracket(1e3, exposures, 60).astype(np.int64) + np.rint(0.355 * offsets_e).astype(np.int64)
    frames = np.maximum(frames, 0).astype(np.uint16)
    uneven = replace(NOISE, DSNU1288_e=4.0)
    merge = merge_bracket(frames, exposures, uneven)
    assert merge.status is FitStatus.CONVERGED, merge.notes
    error = merge.rate_e_per_s - 1e3
    assert error.std() == pytest.approx(np.sqrt(np.mean(merge.sigma_e_per_s**2)), rel=0.05)
    # Offsets that the noise model does not have make a sigma that is too small.
    blind = merge_bracket(frames, exposures, NOISE)
    assert error.std() > 1.01 * np.sqrt(np.mean(blind.sigma_e_per_s**2))
    assert (blind.status is FitStatus.POOR_FIT) == (exposures is EXPOSURES)


@pytest.mark.parametrize(
    "wrong",
    [{"K_DN_per_e": 0.0}, {"K_DN_per_e": np.nan}, {"sigma_d_e": -1.0}, {"saturation_DN": 60.0}, {"q_DN": np.inf},
     {"K_DN_per_e": None}, {"K_DN_per_e": "a"}, {"K_DN_per_e": np.full(1, 0.3)}, {"q_DN": 0.0}, {"q_DN": -1.0},
     {"dark_current_e_per_s": -1e5}, {"dark_current_e_per_s": 1e9}, {"black_DN": -1e9}, {"DSNU1288_e": -5.0},
     {"nonlinearity": 50.0}],
)  # fmt: skip
def test_a_noise_model_that_cannot_be_is_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(FitError, match=r"^Expected .*, found .*\. Fit the noise\.$"):
        merge_bracket(bracket(1e4, EXPOSURES, 0, (8, 8)), EXPOSURES, unchecked(NOISE, **wrong))


@pytest.mark.parametrize("dark", [-20.0, np.float32(3.0), np.array(0)])
def test_a_dark_current_about_zero_is_no_fault(dark: object) -> None:
    merge = merge_bracket(bracket(1e4, EXPOSURES, 0, (8, 8)), EXPOSURES, unchecked(NOISE, dark_current_e_per_s=dark))
    assert merge.used.min() >= 1


def test_a_wrong_black_level_is_told_by_dark_samples() -> None:
    frames = bracket(200.0, EXPOSURES[:5], 8)
    assert merge_bracket(frames, EXPOSURES[:5], NOISE).status is FitStatus.CONVERGED
    wrong = merge_bracket(frames, EXPOSURES[:5], replace(NOISE, black_DN=63.7))
    assert wrong.status is FitStatus.POOR_FIT
    assert "+0.6 DN off the black level" in wrong.notes[-1]


def test_a_wrong_black_level_is_told_where_no_sample_is_dark() -> None:
    frames = bracket(3e4, EXPOSURES[2:5], 8)
    assert merge_bracket(frames, EXPOSURES[2:5], NOISE).status is FitStatus.CONVERGED
    wrong = merge_bracket(frames, EXPOSURES[2:5], replace(NOISE, black_DN=63.3))
    assert wrong.status is FitStatus.POOR_FIT
    assert "DN off the black level" in wrong.notes[-1]


def test_a_frame_of_other_light_is_told_where_exposures_lie_far_apart() -> None:
    # Some 300 electrons fill a pixel: none has three samples of many electrons.
    noise = replace(NOISE, K_DN_per_e=12.0, sigma_d_e=1.0, dark_current_e_per_s=0.0)
    rates, times = np.geomspace(1e2, 2e5, 9000).reshape(90, 100), 1e-3 * 6.0 ** np.arange(4)
    for lamp, status in ((1.0, FitStatus.CONVERGED), (0.85, FitStatus.POOR_FIT)):
        rng = np.random.default_rng(12)
        light = np.where(np.arange(4)[:, None, None] == 0, lamp, 1.0) * rates * times[:, None, None]
        noisy = 64.3 + 12.0 * (rng.poisson(light) + rng.standard_normal(light.shape))
        merge = merge_bracket(np.clip(np.rint(noisy), 0, 3960).astype(np.uint16), times, noise)
        assert merge.status is status
        assert any("light of frame 0 differs" in note for note in merge.notes) is (lamp != 1.0)


def test_a_wrong_time_is_told_of_the_frame_that_gives_most_of_the_light() -> None:
    # Frame 5 decides the light of the pixels that it does not clip: they follow it, and only frame 4 tells.
    noise = replace(NOISE, K_DN_per_e=0.85, black_DN=34.0, saturation_DN=255.0, sigma_d_e=3.4, dark_current_e_per_s=0.0)
    rates, times = np.geomspace(60, 5e6, 12_000), 2e-4 * 5.8 ** np.arange(10)
    for wrong, status in ((1.0, FitStatus.CONVERGED), (1.08, FitStatus.POOR_FIT)):
        rng = np.random.default_rng(3)
        light = rng.poisson(np.minimum(rates * times[:, None], 1e9)) + 3.4 * rng.standard_normal((10, 12_000))
        frames = np.clip(np.rint(34.0 + 0.85 * light), 0, 255).astype(np.uint16)
        merge = merge_bracket(frames, np.where(np.arange(10) == 5, wrong, 1.0) * times, noise)
        assert merge.status is status


def test_a_psf_of_doubted_brackets_says_so() -> None:
    told = psf_notes(PsfData(None, 3, doubted=("psf/1: Check K.",)), None, 1.0, "", ())
    assert "1 of 3 brackets are in doubt. psf/1: Check K." in told
    assert not any("doubt" in note for note in psf_notes(PsfData(None, 3), None, 1.0, "", ()))


def test_two_frames_that_differ_are_told_where_no_third_decides() -> None:
    frames = bracket(3e4, EXPOSURES[3:5], 9)
    exposures = EXPOSURES[3:5] * np.array([1.0, 1.2])
    merge = merge_bracket(frames, exposures, NOISE)
    assert merge.status is FitStatus.POOR_FIT
    assert any("too few pixels have a third sample that tells which one is right" in note for note in merge.notes)
    # The light of a pixel follows its only dark sample: nothing tells the black level.
    assert not any("black level" in note for note in merge.notes)
    three = np.concatenate([frames, bracket(3e4, EXPOSURES[4:5], 10)])
    decided = merge_bracket(three, np.append(exposures, EXPOSURES[4]), NOISE)
    assert [o.places for o in decided.outliers] == [("frame 1",)]
    assert decided.status is FitStatus.CONVERGED


# Frames whose pixels have light of three decades.
TIMES, RATES = 1e-3 * 3.0 ** np.arange(5), np.geomspace(300.0, 3e5, 12_000).reshape(100, 120)


def merged_light(lamp: np.ndarray, bend: float = 0.0, moved: bool = False, told: Noise = NOISE) -> HdrMerge:
    """A bracket whose frames have the light ``lamp``, with a part ``bend`` missing at saturation."""
    rng, full = np.random.default_rng(71), (3960.0 - 64.3) / 0.355
    scene = rng.permuted(RATES.ravel()).reshape(RATES.shape)
    frames = []
    for k, (time, light) in enumerate(zip(TIMES, lamp, strict=True)):
        here = 0.7 * scene + 0.3 * np.roll(scene, 1, axis=1) if moved and k % 2 else scene
        counts = rng.poisson((here * light + 20.0) * time).astype(float)
        counts = np.minimum(counts * (1 - bend * counts / full), full) + 4.5 * rng.standard_normal(scene.shape)
        frames.append(np.clip(np.rint(64.3 + 0.355 * counts), 0, 4095))
    return merge_bracket(np.array(frames, np.uint16), TIMES, told)


@pytest.mark.parametrize("bend", [0.02, 0.05, -0.03])
def test_a_response_that_bends_is_told(bend: float) -> None:
    """Bright light is off by 1.5 sigma of every pixel; a bend that the noise model has is taken out."""
    wrong = merged_light(np.ones(5), bend)
    assert wrong.status is FitStatus.POOR_FIT
    (note,) = (one for one in wrong.notes if "response bends" in one)
    assert float(note.split("off by ")[1].split(" %")[0]) == pytest.approx(-100 * bend, abs=0.8)
    # ``nonlinearity`` is the part of the signal that the quadratic takes from the linear one.
    if bend == 0.02:
        assert merged_light(np.ones(5), bend, told=replace(NOISE, nonlinearity=bend)).status is FitStatus.CONVERGED
    assert not merged_light(np.ones(5)).notes


def test_light_that_differs_a_little_is_told() -> None:
    merged = merged_light(np.array([1, 1, 1, 1, 0.985]))
    assert merged.status is FitStatus.CONVERGED
    (note,) = merged.notes
    assert "light of frame 4 differs by -1.5 %" in note
    assert not merged_light(np.array([1, 1, 1, 1, 0.999])).notes


def test_a_bracket_of_which_most_frames_are_left_out_is_in_doubt() -> None:
    """Every other frame is three tenths of a pixel aside: the two that agree are not the truth."""
    merged = merged_light(np.ones(5), moved=True)
    assert merged.status is FitStatus.POOR_FIT
    assert any("few that agree are left" in note for note in merged.notes)


def test_a_wrong_time_of_a_frame_that_clips_nearly_everywhere_is_told() -> None:
    # Few pixels are as dark as a tenth of a full one, and dark current alone nearly fills them in the last frame.
    noise = replace(NOISE, K_DN_per_e=3.41, black_DN=20.0, saturation_DN=1023.0, sigma_d_e=0.4)
    rates, times = np.geomspace(2.8, 2.8e5, 12_000), 7.5e-4 * 2.9 ** np.arange(10)
    for wrong, status in ((1.0, FitStatus.CONVERGED), (0.75, FitStatus.POOR_FIT), (1.27, FitStatus.POOR_FIT)):
        rng = np.random.default_rng(6)
        light = rng.poisson((rates + 20.0) * times[:, None]) + 0.4 * rng.standard_normal((10, 12_000))
        frames = np.clip(np.rint(20.0 + 3.41 * light), 0, 1023).astype(np.uint16)
        merge = merge_bracket(frames, np.where(np.arange(10) == 9, wrong, 1.0) * times, noise)
        assert merge.status is status
        assert any("light of frame 9 differs" in note for note in merge.notes) is (wrong != 1.0)


def test_a_gain_that_is_too_large_by_a_tenth_is_told_of_few_pixels() -> None:
    # Samples scatter less than with the right gain; no more than 300 electrons, of which few pixels have two samples.
    noise = replace(NOISE, K_DN_per_e=13.65, black_DN=160.0, saturation_DN=4095.0, sigma_d_e=0.33)
    rates, times = np.geomspace(1.0, 1e5, 5000), 1.4e-3 * 5.5 ** np.arange(6)
    rng = np.random.default_rng(7)
    light = rng.poisson((rates + 20.0) * times[:, None]) + 0.33 * rng.standard_normal((6, 5000))
    frames = np.clip(np.rint(160.0 + 13.65 * light), 0, 4095).astype(np.uint16)
    assert merge_bracket(frames, times, noise).status is FitStatus.CONVERGED
    wrong = merge_bracket(frames, times, replace(noise, K_DN_per_e=1.11 * 13.65))
    assert wrong.status is FitStatus.POOR_FIT
