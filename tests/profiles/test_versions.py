from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from jax.tree_util import tree_leaves

from udccal.errors import ProfileError
from udccal.profiles.schema import VERSION
from udccal.profiles.store import load_profile, read_profile, write_profile
from udccal.profiles.versions import JsonObject, migrated
from udccal.rig_folders import shipped_rig_folder


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


def stored_in_version_1(folder: Path, change: Callable[[JsonObject], object] = lambda _: None) -> Path:
    """The shipped profile as version 1 stored it, changed."""
    shutil.copytree(shipped_rig_folder() / "lg55-reduced" / "profile", folder)
    document = json.loads((Path(__file__).parent / "stored" / "version_1.json").read_bytes())
    change(document)
    (folder / "profile.json").write_text(json.dumps(document))
    return folder


def test_version_1_is_read_as_the_same_profile(tmp_path: Path) -> None:
    old = read_profile(stored_in_version_1(tmp_path / "old"))
    new = load_profile("lg55-reduced")
    assert old.rig == new.rig
    for name in ("noise", "geometry", "wire", "psf", "backscatter"):
        before, after = getattr(old, name), getattr(new, name)
        assert before.estimates == after.estimates
        for a, b in zip(tree_leaves(before.term), tree_leaves(after.term), strict=True):
            np.testing.assert_array_equal(a, b)
    write_profile(tmp_path / "written", old)
    assert json.loads((tmp_path / "written" / "profile.json").read_bytes())["version"] == VERSION


BROKEN: dict[str, tuple[Callable[[JsonObject], object], str]] = {
    "no terms": (lambda d: d.pop("terms"), "'terms'"),
    "terms of another kind": (lambda d: d.update(terms=[1]), "'terms'"),
    "a section of another kind": (lambda d: d["terms"].update(wire=3), "'terms.wire'"),
    "parameters of another kind": (lambda d: d["terms"]["wire"].update(parameters={"name": 1}), "parameters"),
    "an unnamed parameter": (lambda d: d["terms"]["wire"]["parameters"][1].update(name=[1]), "name"),
    "a name of version 2": (lambda d: d["terms"]["wire"]["parameters"][1].update(name="tilt"), "rotation_rad"),
    "a rig without a panel": (lambda d: d["rig"].pop("panel"), "'rig.panel'"),
    "a rig of another kind": (lambda d: d.update(rig=[]), "'rig'"),
}


@pytest.mark.parametrize("fault", BROKEN)
def test_a_broken_profile_of_version_1_is_a_sentence(tmp_path: Path, fault: str) -> None:
    change, words = BROKEN[fault]
    with pytest.raises(ProfileError, match=words):
        read_profile(stored_in_version_1(tmp_path / "old", change))
