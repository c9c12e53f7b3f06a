"""Captures that a term was fitted to, known by their digests, also where some were captured again."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tests.profiles.conftest import fitted
from udccal.result import FitResult
from udccal.sessions.evidence import captures_of
from udccal.sessions.schema import DarkSubject, StoredCapture, StoredRegion, StoredStep
from udccal.validation.own import Fitted, fitted_steps


def step(number: int, minute: int, day: int = 1) -> StoredStep:
    capture = StoredCapture(
        file=f"noise/dark_{number}.png",
        sha256=f"{number + 100 * minute + 10_000 * day:064x}",
        kind="frame",
        frames=1,
        exposure_s=0.1,
        gain_dB=0.0,
        first_timestamp_s=0.0,
        last_timestamp_s=0.0,
        region=StoredRegion(x=0, y=0, columns=8, rows=8),
    )
    time = f"2026-03-0{day}T10:{minute:02d}:00+00:00"
    return StoredStep(
        id=f"noise/dark_{number}", term="noise", subject=DarkSubject(), completed_at=time, captures=(capture,)
    )


STEPS = tuple(step(number, number) for number in range(4))


@pytest.fixture(scope="module")
def result() -> FitResult:
    return replace(fitted("noise", None), captures=captures_of(STEPS))


def test_the_same_captures_are_all_those_of_the_fit(result: FitResult) -> None:
    assert fitted_steps(result, STEPS[::-1], False) == Fitted(4, 4, True)
    assert not fitted_steps(result, STEPS, False).partly


@pytest.mark.parametrize(
    ("steps", "count"),
    [
        ((*STEPS[:3], step(3, 50)), 3),
        ((step(0, 50), *STEPS[1:]), 3),
        (STEPS[:2], 2),
        ((*STEPS, step(4, 50)), 4),
    ],
    ids=["last again", "first again", "fewer", "one more"],
)
def test_a_step_captured_again_leaves_the_others_those_of_the_fit(
    result: FitResult, steps: tuple[StoredStep, ...], count: int
) -> None:
    found = fitted_steps(result, steps, False)
    assert (found.count, found.steps, found.partly) == (count, len(steps), True)


def test_captures_of_another_day_are_not_those_of_the_fit(result: FitResult) -> None:
    later = tuple(step(number, number, day=2) for number in range(4))
    assert fitted_steps(result, later, False) == Fitted(0, 4, False)


def test_without_captures_in_the_profile_its_session_alone_is_its_own(result: FitResult) -> None:
    unnamed = replace(result, captures=None)
    assert fitted_steps(unnamed, STEPS, True) == Fitted(4, 4, True)
    assert fitted_steps(unnamed, STEPS, False) == Fitted(0, 4, False)
    assert fitted_steps(result, (), True) == Fitted(0, 0, False)


def test_of_a_profile_that_does_not_name_steps_only_all_together_can_be_told(result: FitResult) -> None:
    assert result.captures is not None
    older = replace(result, captures=replace(result.captures, steps=None))
    assert fitted_steps(older, STEPS, False).whole
    assert fitted_steps(older, STEPS[:2], False) == Fitted(0, 2, False)
