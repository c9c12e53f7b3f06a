"""Captures of two sessions against each other where they hold little: stuck pixels, and flats that tell no gain."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import create_autospec

import numpy as np
import pytest

from tests.scenes.noise import ToySensor, captured
from tests.validation.judged import failed, named
from udccal.rig import RigDescription, load_rig
from udccal.sessions.store import Average, Session
from udccal.validation import pairs
from udccal.validation.limits import ValidationLimits

SENSOR = ToySensor()


def flats(rig: RigDescription, seed: int, stuck: tuple[int, ...]) -> Session:
    """A session of one flat and its dark frame; of ``stuck`` pixels both have the largest code."""
    rng, shape, averages = np.random.default_rng(seed), (rig.camera.rows, rig.camera.columns), dict[str, Average]()
    for name, level, variance in (("wire/flat", 2000.0, 700.0), ("wire/dark", 64.0, 4.0)):
        mean = rng.normal(level, np.sqrt(variance / 10), shape).astype(np.float32)
        spread = np.full(shape, variance, dtype=np.float32)
        mean.ravel()[list(stuck)], spread.ravel()[list(stuck)] = 4095.0, 0.0
        averages[name] = Average(mean, spread, 10)
    session: Session = create_autospec(Session, instance=True, rig=rig)
    session.step = lambda name: SimpleNamespace(captures=(name,))  # type: ignore[method-assign,assignment,return-value]
    session.average = averages.__getitem__  # type: ignore[method-assign,assignment]
    return session


@pytest.mark.parametrize("stuck", [(), (0,)], ids=["none", "one"])
def test_a_stuck_pixel_does_not_stop_the_comparison_of_flats(stuck: tuple[int, ...]) -> None:
    """It has the same code with and without light, and so neither signal nor sigma."""
    rig = load_rig("lg55-reduced")
    found = pairs.compare_flats(flats(rig, 1, stuck), flats(rig, 2, stuck), ValidationLimits())
    assert not failed(found)
    assert named(found, "chi-squared").value == pytest.approx(1.0, abs=0.05)


def test_flats_that_tell_no_gain_are_refused_with_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = iter((captured(SENSOR, 1), captured(replace(SENSOR, levels=(1.6, 2.0)), 2)))
    monkeypatch.setattr(pairs, "read_noise", lambda _: next(seen))
    session = create_autospec(Session, instance=True)
    found = pairs.compare_noise(session, session, ValidationLimits())
    assert failed(found) == {"captures"}
    assert "no gain" in found.checks[0].what
