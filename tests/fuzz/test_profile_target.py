"""The target that restores with changed profiles notices what a range is there for."""

from __future__ import annotations

import json
from typing import Any

import pytest

from tests.fuzz import profile_targets as target
from tests.fuzz.profile_targets import PROFILE_TARGETS


def _step_of_nothing() -> bytes:
    """The change that sets the spacing of the backscatter's grid to 0."""
    whole = target._whole()
    parameters: list[dict[str, Any]] = json.loads(whole.text)["terms"]["backscatter"]["parameters"]
    index = next(at for at, parameter in enumerate(parameters) if parameter["name"] == "step")
    place = whole.places.index(("terms", "backscatter", "parameters", index, "value"))
    return target._CHANGE.pack(place, 6, 0, 0)


@pytest.mark.medium
def test_a_range_that_is_not_checked_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    (profile,) = PROFILE_TARGETS
    assert not profile.try_out(_step_of_nothing())
    monkeypatch.setattr("udccal.profiles.encode.check_term", lambda *_: None)
    with pytest.raises(ZeroDivisionError):
        profile.try_out(_step_of_nothing())
