from __future__ import annotations

import pytest

from udccal.errors import ProfileError
from udccal.profiles.versions import JsonObject, migrated


def first_to_second(found: JsonObject) -> JsonObject:
    return {**found, "version": 2, "steps": [1]}


def second_to_third(found: JsonObject) -> JsonObject:
    return {**found, "version": 3, "steps": [*found["steps"], 2]}


def test_older_versions_go_through_every_step() -> None:
    old = {"format": "udccal-profile", "version": 1}
    new = migrated(old, "p", {1: first_to_second, 2: second_to_third}, target=3)
    assert new == {"format": "udccal-profile", "version": 3, "steps": [1, 2]}


@pytest.mark.parametrize("version", [None, "1", 0, True, 1.0])
def test_a_version_must_be_a_number(version: object) -> None:
    with pytest.raises(ProfileError, match="version number"):
        migrated({"format": "udccal-profile", "version": version}, "p")


def test_newer_and_forgotten_versions_are_refused() -> None:
    with pytest.raises(ProfileError, match="newer version 4"):
        migrated({"format": "udccal-profile", "version": 4}, "p", {}, target=3)
    with pytest.raises(ProfileError, match="no longer reads"):
        migrated({"format": "udccal-profile", "version": 1}, "p", {2: second_to_third}, target=3)
