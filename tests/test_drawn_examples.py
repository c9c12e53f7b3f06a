"""How hypothesis draws in every test that does not say otherwise."""

from __future__ import annotations

from hypothesis import settings


def test_no_drawn_example_has_a_deadline_and_every_run_draws_the_same() -> None:
    # A deadline fails wherever the machine is busy.
    assert settings().deadline is None
    assert settings().derandomize
