"""Pictures of LEDs as their own kernel predicts them, and as a defocused one does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.profiles.conftest import fitted
from tests.scenes.psf import pictures, shots_of, small_scene
from tests.validation.judged import failed, named
from udccal.fitting.psf.data import PsfData
from udccal.fitting.psf.fit import nominal_psf
from udccal.fitting.psf.start import pack
from udccal.models.psf import PsfField
from udccal.result import Diagnostic, FitResult
from udccal.validation.limits import ValidationLimits
from udccal.validation.psf import judge_psf

pytestmark = pytest.mark.slow


def result_of(term: PsfField) -> FitResult[PsfField]:
    return replace(fitted("psf", term), diagnostics=(Diagnostic("model_error", 0.005, "1"),))


@pytest.fixture(scope="module")
def term() -> PsfField:
    scene = small_scene((2, 2), 2)
    return nominal_psf(scene.rig, scene.geometry, scene.wire)


@pytest.fixture(scope="module")
def data(term: PsfField) -> PsfData:
    scene, rng = small_scene((2, 2), 2), np.random.default_rng(1)
    made = pictures(scene, pack(term.diffraction), rng)
    return PsfData(shots_of(scene, made, rng), len(made))


def test_the_same_kernels_spots_are_predicted(term: PsfField, data: PsfData) -> None:
    found = judge_psf(data, result_of(term), ValidationLimits(), own=False)
    assert not failed(found)
    assert (named(found, "LED's picture, L2").value or 9.0) < 1.5


def test_kernels_of_round_corners_predict_their_own_spots_and_not_those_of_square_ones(
    term: PsfField, data: PsfData
) -> None:
    round_ones = replace(term, diffraction=replace(term.diffraction, corner_radius=np.float64(0.15)))
    scene, rng = small_scene((2, 2), 2), np.random.default_rng(1)
    made = pictures(scene, pack(round_ones.diffraction), rng)
    own = PsfData(shots_of(scene, made, rng), len(made))
    assert not failed(judge_psf(own, result_of(round_ones), ValidationLimits(), own=False))
    assert failed(judge_psf(data, result_of(round_ones), ValidationLimits(), own=False))


def test_a_defocused_kernel_fails(term: PsfField, data: PsfData) -> None:
    soft = replace(term, diffraction=replace(term.diffraction, blur_px=np.float64(0.8)))
    found = judge_psf(data, result_of(soft), ValidationLimits(), own=False)
    assert {"LED's picture, L2", "pattern of the LEDs' pictures", "chi-squared"} <= failed(found)


@pytest.mark.parametrize("seed", [2, 3])
def test_the_same_spots_in_other_noise_have_no_pattern(term: PsfField, seed: int) -> None:
    scene, rng = small_scene((2, 2), 2), np.random.default_rng(seed)
    again = pictures(scene, pack(term.diffraction), rng)
    found = judge_psf(PsfData(shots_of(scene, again, rng), len(again)), result_of(term), ValidationLimits(), own=False)
    assert not failed(found)
    assert (named(found, "pattern of the LEDs' pictures").value or 0.0) < 0.5


def test_wider_openings_leave_a_pattern(term: PsfField, data: PsfData) -> None:
    wider = replace(term.diffraction, openings=np.asarray(term.diffraction.openings) + np.array([0.0, 0.02]))
    found = judge_psf(data, result_of(replace(term, diffraction=wider)), ValidationLimits(), own=False)
    assert "pattern of the LEDs' pictures" in failed(found)
    assert "a pattern of" in named(found, "pattern of the LEDs' pictures").what


def test_of_the_profiles_own_session_only_held_out_positions_count(term: PsfField, data: PsfData) -> None:
    found = judge_psf(data, result_of(term), ValidationLimits(), own=True)
    assert "1 places" in found.checks[0].what


def test_an_image_without_diffraction_is_not_counted(term: PsfField, data: PsfData) -> None:
    image = replace(term, diffraction_fraction=np.float64(0.0))
    assert [check.ok for check in judge_psf(data, result_of(image), ValidationLimits(), own=False).checks] == [None]


def test_no_led_cannot_be_judged(term: PsfField) -> None:
    assert failed(judge_psf(PsfData(None, 9, 9), result_of(term), ValidationLimits(), own=False)) == {"captures"}
