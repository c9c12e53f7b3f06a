"""What more captures would bring: curves that fall, what does not matter named, and what a fit leaves unused."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
import pytest

from udccal.planning import forecast as module
from udccal.planning.forecast import Limits, forecast
from udccal.planning.state import nominal_state
from udccal.rig import Captures, load_rig


@final
@dataclass(frozen=True)
class _Made:
    """Sigma that falls with the pictures and not with the frames of each; none below ``fewest``."""

    fewest: int = 0

    def sigma(self, captures: Captures) -> float:
        enough = captures.backscatter_pictures > self.fewest
        return float(captures.backscatter_pictures) ** -0.5 if enough else float("inf")

    def limits(self, captures: Captures) -> Limits:
        return Limits(0.01, "Another model would lower it.", 0.25)


def test_curves_reach_from_a_quarter_to_four_times(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "PREDICTORS", {"backscatter": lambda state: _Made()})
    found = forecast("backscatter", nominal_state(load_rig("lg55-aca2040")))
    assert found is not None
    (curve,) = found.curves
    assert (curve.counts[0], curve.now, curve.counts[-1]) == (6, 24, 96)
    assert np.all(np.diff(curve.sigma) < 0)
    assert curve.most_gain == pytest.approx(2.0)
    assert found.idle == ("frames of a picture",)
    assert (found.limits.used, found.limits.floor) == (0.25, 0.01)


def test_captures_that_do_not_suffice_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    state = nominal_state(load_rig("lg55-aca2040"))
    monkeypatch.setattr(module, "PREDICTORS", {"backscatter": lambda state: _Made(fewest=12)})
    found = forecast("backscatter", state)
    assert found is not None
    assert found.curves[0].counts[0] > 12
    monkeypatch.setattr(module, "PREDICTORS", {"backscatter": lambda state: _Made(fewest=1000)})
    assert forecast("backscatter", state) is None


def test_levels_tell_the_gain_and_the_stack_does_not() -> None:
    found = forecast("noise", nominal_state(load_rig("lg55-reduced")))
    assert found is not None
    assert [curve.variable.name for curve in found.curves] == ["noise_levels"]
    assert found.idle == ("frames of a stack",)
    assert found.curves[0].most_gain == pytest.approx(2.0, rel=0.1)
