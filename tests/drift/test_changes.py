"""Each change with its error bar."""

from __future__ import annotations

import numpy as np
import pytest

from udccal.drift.changes import panel_level
from udccal.drift.limits import DriftLimits
from udccal.profiles.profile import Profile
from udccal.profiles.store import load_profile


@pytest.fixture(scope="module")
def profile() -> Profile:
    return load_profile("lg55-reduced")


@pytest.mark.parametrize(("gain_sigma", "significant"), [(5e-4, True), (5e-3, False)])
def test_the_panels_level_has_the_error_of_the_gain_that_it_is_divided_by(
    profile: Profile, gain_sigma: float, significant: bool
) -> None:
    found = panel_level(profile, np.array([1.0, 0.99, 1.0]), gain_sigma, DriftLimits())
    assert found.value == pytest.approx(1.0)
    assert found.significant is significant


def test_a_panel_at_nine_tenths_matters(profile: Profile) -> None:
    assert panel_level(profile, np.array([0.9, 0.9, 0.9]), 3e-3, DriftLimits()).harmful
