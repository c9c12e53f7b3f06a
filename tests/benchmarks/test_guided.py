"""The table of guided captures refuses wider error bars, and judges only what the data decide."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from tests.benchmarks.draws import Draw
from tests.benchmarks.guided import (
    Calibrated,
    Pair,
    _Counted,
    judged,
    noise_ratios,
    prompts_and_sigmas,
    sigma_ratios,
)
from udccal.guide.events import Answer, VerdictEvent
from udccal.profiles.profile import Profile
from udccal.profiles.store import load_profile
from udccal.result import Diagnostic, FitResult


@pytest.fixture(scope="module")
def shipped() -> Profile:
    profile = load_profile("lg55-reduced")
    told = *profile.psf.diagnostics, Diagnostic("noise_sigma_depth_mm", 1e-3, "mm")
    return dataclasses.replace(profile, psf=dataclasses.replace(profile.psf, diagnostics=told))


def wider(result: FitResult, by: float) -> FitResult:
    estimates = tuple(dataclasses.replace(each, sigma=by * each.sigma) for each in result.estimates)
    return dataclasses.replace(result, estimates=estimates)


def test_sigmas_are_compared_by_name(shipped: Profile) -> None:
    ratios = sigma_ratios(shipped.geometry, wider(shipped.geometry, 1.2))
    assert {"fx", "cx", "k1", "tilt_deg"} <= ratios.keys()
    assert all(ratio == pytest.approx(1.2) for ratio in ratios.values())
    # Its sigma is the rig's tolerance, however an LED is held.
    assert "pitch_mm" not in sigma_ratios(shipped.psf, shipped.psf)


def test_what_captures_tell_is_compared_without_the_models_deviation(shipped: Profile) -> None:
    def known(by: float) -> FitResult:
        told = Diagnostic("noise_sigma_depth_mm", by * 1e-3, "mm"), Diagnostic("iterations", 7.0, "1")
        return dataclasses.replace(wider(shipped.psf, 1 / by), diagnostics=told)

    assert noise_ratios(known(1.0), known(1.2)) == pytest.approx({"depth_mm": 1.2})


@pytest.mark.parametrize(("by", "prompts", "missed"), [(1.0, 12, 0), (1.2, 12, 2), (1.0, 41, 1)])
def test_wider_error_bars_and_many_prompts_are_missed(shipped: Profile, by: float, prompts: int, missed: int) -> None:
    changed = dataclasses.replace(shipped, geometry=wider(shipped.geometry, by))
    pair = Pair(Draw("lg55-reduced", 0), Calibrated(shipped, 0, "a"), Calibrated(changed, prompts, "b"))
    assert sum(not row.ok for row in prompts_and_sigmas([pair])) == missed


@pytest.mark.medium
def test_errors_of_another_specimen_are_missed(shipped: Profile) -> None:
    pair = Pair(Draw("lg55-reduced", 1), Calibrated(shipped, 0, "a"), Calibrated(shipped, 12, "b"))
    rows = [row for row in judged([pair]) if row.name.startswith("guided:")]
    assert any(not row.ok for row in rows)


@pytest.mark.parametrize(("wide", "missed"), [(1, 0), (2, 2)])
def test_of_several_specimens_the_median_counts(shipped: Profile, wide: int, missed: int) -> None:
    changed = dataclasses.replace(shipped, geometry=wider(shipped.geometry, 1.2))
    commanded, draw = Calibrated(shipped, 0, "a"), Draw("lg55-reduced", 0)
    by_hand = [Calibrated(changed if number < wide else shipped, 12, "b") for number in range(3)]
    rows = prompts_and_sigmas([Pair(draw, commanded, guided) for guided in by_hand])
    assert sum(not row.ok for row in rows) == missed


def test_prompts_of_a_stopped_run_count(tmp_path: Path) -> None:
    asked = tmp_path / "prompts.txt"
    for expected in ("1", "2"):
        person = _Counted(asked)
        person.tell(VerdictEvent("dark", True, "", (Answer.go,)))
        assert person.answer((Answer.go,), 0.0) is Answer.go
        assert asked.read_text() == expected
    person = _Counted(asked)
    person.tell(VerdictEvent("dark", False, "Light leaks in.", (Answer.go,)))
    assert person.answer((Answer.go,), 0.0) is None
    assert asked.read_text() == "2"
