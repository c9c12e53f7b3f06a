from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from jax.tree_util import tree_leaves

from udccal.errors import ProfileError
from udccal.models.geometry import Geometry
from udccal.models.psf import PsfField
from udccal.models.wire import Wire
from udccal.profiles.packing import Packed, unpack
from udccal.profiles.profile import Profile
from udccal.profiles.schema import VERSION, StoredProfile
from udccal.profiles.store import read_profile, read_stored, write_profile
from udccal.profiles.versions import JsonObject, migrated
from udccal.reports.fit_tables import captures_sentence


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


@pytest.mark.parametrize("version", [10**4000, "1" * 4000])
def test_a_long_version_is_shortened(version: object) -> None:
    with pytest.raises(ProfileError, match="version") as refused:
        migrated({"format": "udccal-profile", "version": version}, "p")
    assert len(str(refused.value)) < 200


def test_newer_and_forgotten_versions_are_refused() -> None:
    with pytest.raises(ProfileError, match="newer version 4"):
        migrated({"format": "udccal-profile", "version": 4}, "p", {}, target=3)
    with pytest.raises(ProfileError, match="no longer reads"):
        migrated({"format": "udccal-profile", "version": 1}, "p", {2: second_to_third}, target=3)


def stored_in_version(version: int, folder: Path, change: Callable[[JsonObject], object] = lambda _: None) -> Path:
    """One profile's JSON as an older version stored it, changed; without its arrays."""
    document = json.loads((Path(__file__).parent / "stored" / f"version_{version}.json").read_bytes())
    change(document)
    folder.mkdir()
    (folder / "profile.json").write_text(json.dumps(document))
    return folder


def unpacked(stored: StoredProfile, folder: Path) -> tuple[object, ...]:
    """The terms whose arrays are all in the JSON."""
    sections = ((stored.terms.geometry, Geometry), (stored.terms.wire, Wire), (stored.terms.psf, PsfField))
    geometry, *others = ((Packed(section.parameters, section.arrays), kind) for section, kind in sections)
    shared = unpack(*geometry, folder, None)
    return (shared, *(unpack(packed, kind, folder, shared) for packed, kind in others))


def test_older_versions_are_read_as_the_same_profile(tmp_path: Path) -> None:
    first, second = (read_stored(stored_in_version(v, tmp_path / f"{v}")) for v in (1, 2))
    assert first.version == second.version == VERSION
    assert first.rig == second.rig
    for a, b in zip(*(tree_leaves(unpacked(one, tmp_path)) for one in (first, second)), strict=True):
        np.testing.assert_array_equal(a, b)
    for one, other in zip(first.terms, second.terms, strict=True):
        assert one[1].fit == other[1].fit


def test_what_older_versions_did_not_keep_is_unknown_and_not_invented(tmp_path: Path) -> None:
    stored = read_stored(stored_in_version(2, tmp_path / "p"))
    for _, section in stored.terms:
        fit = section.fit
        assert (fit.outliers, fit.residuals, fit.captures, fit.effort) == (None, None, None, None)
        assert {one.prior for one in fit.estimates} == {None}
        assert all(one.what.endswith(".") for one in fit.estimates)
    assert {picture.name for picture in stored.pictures} == {"wire_map", "psf_atlas", "backscatter_white"}


def written_in_version_2(folder: Path, profile: Profile) -> Path:
    """A profile with its arrays as version 2 wrote it."""
    write_profile(folder, profile)
    document = json.loads((folder / "profile.json").read_bytes())
    document["version"], document["pictures"] = 2, document["pictures"][:3]
    noise, psf = document["terms"]["noise"], document["terms"]["psf"]
    noise["parameters"] = [one for one in noise["parameters"] if one["name"] != "nonlinearity"]
    names = "blur_growth", "blur_colour", "depth_ratio", "bar_width", "bar_place", "corner_radius", "slant"
    later = {f"diffraction.{name}" for name in names}
    psf["parameters"] = [one for one in psf["parameters"] if one["name"] not in later]
    for section in document["terms"].values():
        for name in ("outliers", "residuals", "captures", "effort"):
            section["fit"].pop(name)
        for one in section["fit"]["estimates"]:
            one.pop("what")
            one.pop("prior")
    (folder / "profile.json").write_text(json.dumps(document))
    return folder


def test_an_older_profile_is_read_and_written_anew(tmp_path: Path, toy_profile: Profile) -> None:
    """Written again, what is unknown stays unknown; what the older version has not is gone."""
    old = read_profile(written_in_version_2(tmp_path / "p", toy_profile))
    assert old.wire.map_sigma is None
    assert old.noise.estimates == tuple(replace(one, prior=None) for one in toy_profile.noise.estimates)
    write_profile(tmp_path / "again", old)
    again = json.loads((tmp_path / "again" / "profile.json").read_bytes())
    assert again["version"] == VERSION
    assert again["terms"]["noise"]["fit"]["outliers"] is None
    assert "not known" in captures_sentence(read_profile(tmp_path / "again").noise)


def test_a_blur_of_version_3_is_the_same_all_over_the_field_and_in_all_colours(
    tmp_path: Path, toy_profile: Profile
) -> None:
    old = read_profile(written_in_version_2(tmp_path / "p", toy_profile)).psf.term.diffraction
    np.testing.assert_array_equal(old.blur_growth, np.zeros(2))
    np.testing.assert_array_equal(old.blur_colour, np.zeros(3))
    assert old.blur_px == toy_profile.psf.term.diffraction.blur_px


def test_frames_of_version_4_are_linear(tmp_path: Path, toy_profile: Profile) -> None:
    bent = replace(toy_profile.noise, term=replace(toy_profile.noise.term, nonlinearity=0.01))
    old = read_profile(written_in_version_2(tmp_path / "p", replace(toy_profile, noise=bent))).noise.term
    assert old == toy_profile.noise.term
    assert toy_profile.noise.term.nonlinearity == 0.0


BROKEN: dict[str, tuple[Callable[[JsonObject], object], str]] = {
    "no terms": (lambda d: d.pop("terms"), "'terms'"),
    "terms of another kind": (lambda d: d.update(terms=[1]), "'terms'"),
    "a section of another kind": (lambda d: d["terms"].update(wire=3), "'terms.wire'"),
    "parameters of another kind": (lambda d: d["terms"]["wire"].update(parameters={"name": 1}), "parameters"),
    "a psf without parameters": (lambda d: d["terms"]["psf"].update(parameters=None), "parameters"),
    "a psf parameter of another kind": (lambda d: d["terms"]["psf"]["parameters"].append(5), "parameters"),
    "an unnamed parameter": (lambda d: d["terms"]["wire"]["parameters"][1].update(name=[1]), "name"),
    "a name of version 2": (lambda d: d["terms"]["wire"]["parameters"][1].update(name="tilt"), "rotation_rad"),
    "a rig without a panel": (lambda d: d["rig"].pop("panel"), "'rig.panel'"),
    "a rig of another kind": (lambda d: d.update(rig=[]), "'rig'"),
}


@pytest.mark.parametrize("fault", BROKEN)
def test_a_broken_profile_of_version_1_is_a_sentence(tmp_path: Path, fault: str) -> None:
    change, words = BROKEN[fault]
    with pytest.raises(ProfileError, match=words):
        unpacked(read_stored(stored_in_version(1, tmp_path / "old", change)), tmp_path)


BROKEN_2: dict[str, tuple[Callable[[JsonObject], object], str]] = {
    "a fit of another kind": (lambda d: d["terms"]["wire"].update(fit=3), "'terms.wire.fit'"),
    "no fit": (lambda d: d["terms"]["wire"].pop("fit"), "'terms.wire.fit'"),
    "estimates of another kind": (lambda d: d["terms"]["psf"]["fit"].update(estimates={"name": 1}), "estimates"),
    "an estimate of another kind": (lambda d: d["terms"]["psf"]["fit"]["estimates"].insert(0, 7), "estimates.0"),
    "an estimate without a name": (lambda d: d["terms"]["psf"]["fit"]["estimates"][0].pop("name"), "name"),
}  # fmt: skip


@pytest.mark.parametrize("fault", BROKEN_2)
def test_a_broken_profile_of_version_2_is_a_sentence(tmp_path: Path, fault: str) -> None:
    change, words = BROKEN_2[fault]
    with pytest.raises(ProfileError, match=words):
        read_stored(stored_in_version(2, tmp_path / "old", change))
