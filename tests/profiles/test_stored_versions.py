"""Whole profiles that older udccals wrote: each is read as it was, and refused in a sentence where it is broken.

``stored/version_3.zip`` is the calibration of a simulated rig of 96 x 72 pixels by the command of its time, without a
board; one in so many residuals is kept. The udccal of version 4 has read it, given the psf's blur a growth and colours,
and written ``stored/version_4.zip``; that of version 5 has read this one, given the response a bend, and written
``stored/version_5.zip``, which that of version 6 has migrated.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np
import pytest

from tests.profiles.test_store import TERMS, assert_same
from udccal.errors import ProfileError
from udccal.profiles.copies import migrate_profile
from udccal.profiles.history import history
from udccal.profiles.profile import Profile
from udccal.profiles.schema import VERSION
from udccal.profiles.store import read_profile, write_profile
from udccal.profiles.versions import JsonObject
from udccal.result import FitStatus

STORED: Final = {version: Path(__file__).parent / "stored" / f"version_{version}.zip" for version in (3, 4, 5, 6, 7)}
# Of psf parameters, those that version 4 added.
BLUR: Final = ("blur_growth", "blur_colour")


def document_of(version: int) -> JsonObject:
    """What an older udccal wrote, as it stands there."""
    with zipfile.ZipFile(STORED[version]) as archive:
        found: JsonObject = json.loads(archive.read("profile.json"))
    return found


@pytest.fixture(scope="module", params=STORED)
def version(request: pytest.FixtureRequest) -> int:
    return int(request.param)


@pytest.fixture(scope="module")
def document(version: int) -> JsonObject:
    found = document_of(version)
    assert found["version"] == version
    return found


@pytest.fixture(scope="module")
def profile(version: int) -> Profile:
    return read_profile(STORED[version])


def at(term: object, name: str) -> object:
    for part in name.split("."):
        term = getattr(term, part)
    return term


def test_every_number_survives(document: JsonObject, profile: Profile) -> None:
    compared = 0
    for name in TERMS:
        for one in document["terms"][name]["parameters"]:
            if one["kind"] in ("number", "numbers"):
                value = np.reshape(one["value"], one.get("shape", ()))
                np.testing.assert_array_equal(at(profile.result(name).term, one["name"]), value, one["name"])
                compared += 1
    assert compared >= 50


@pytest.mark.medium
def test_a_migration_changes_no_term(version: int, tmp_path: Path) -> None:
    old = tmp_path / "old.zip"
    old.write_bytes(STORED[version].read_bytes())
    migrate_profile(old, tmp_path / "new")
    newest, _ = history(tmp_path / "new")
    assert newest.changed == ()


def test_every_fit_survives(document: JsonObject, profile: Profile) -> None:
    for name in TERMS:
        fit, result = document["terms"][name]["fit"], profile.result(name)
        assert (result.status.name, result.effort, list(result.notes)) == (fit["status"], fit["effort"], fit["notes"])
        assert (result.chi2_dof, result.samples) == (fit["chi2_dof"], fit["samples"])
        for mine, theirs in zip(result.estimates, fit["estimates"], strict=True):
            assert (mine.name, mine.value, mine.sigma) == (theirs["name"], theirs["value"], theirs["sigma"])
            prior = None if mine.prior is None else {"value": mine.prior.value, "sigma": mine.prior.sigma}
            assert prior == (None if theirs["prior"] is None else {key: theirs["prior"][key] for key in prior or ()})
        if fit["captures"] is not None:
            assert result.captures is not None
            assert (result.captures.sha256, result.captures.frames) == (
                fit["captures"]["sha256"],
                fit["captures"]["frames"],
            )


def test_maps_covariances_and_residuals_survive(document: JsonObject, profile: Profile) -> None:
    rows, columns = document["rig"]["camera"]["rows"], document["rig"]["camera"]["columns"]
    assert profile.wire_map.shape[-2:] == (rows, columns) == (72, 96)
    assert 0.01 < profile.wire_map.std() < 0.5
    assert profile.wire.map_sigma is not None
    for name in ("noise", "wire", "psf", "backscatter"):
        result = profile.result(name)
        assert result.residuals is not None
        assert 10 < len(result.residuals.z) < 500
        assert np.isfinite(result.cov).all()
        assert len(result.cov) > 0
    assert profile.geometry.status is FitStatus.NOT_CAPTURED


def test_where_it_comes_from_survives(document: JsonObject, profile: Profile) -> None:
    provenance = profile.provenance
    assert provenance.session_sha256 == document["provenance"]["session_sha256"]
    assert provenance.command == document["provenance"]["command"]
    assert list(profile.invalidated_by) == document["invalidated_by"]
    assert (profile.rig.name, profile.rig.camera.columns) == ("toy", 96)


def test_what_came_later_is_as_it_was_meant_before(version: int, document: JsonObject, profile: Profile) -> None:
    assert profile.noise.term.nonlinearity == (0.015625 if version >= 5 else 0.0)
    captures = [profile.result(name).captures for name in TERMS]
    assert sum(one is not None for one in captures) >= 4
    assert {one.steps for one in captures if one is not None} == {None}
    stored = {one["name"] for one in document["terms"]["psf"]["parameters"]}
    assert (version >= 4) == all(f"diffraction.{name}" in stored for name in BLUR)
    growth, colour = ([0.125, -0.0625], [0.03125, 0.0, -0.015625]) if version >= 4 else (np.zeros(2), np.zeros(3))
    np.testing.assert_array_equal(profile.psf.term.diffraction.blur_growth, growth)
    np.testing.assert_array_equal(profile.psf.term.diffraction.blur_colour, colour)
    # Rows were as deep as columns, and openings were rectangles without a bar.
    for name in ("depth_ratio", "bar_width", "bar_place", "corner_radius", "slant"):
        assert (f"diffraction.{name}" in stored) == (version >= 7 and name != "slant")
        assert not np.any(getattr(profile.psf.term.diffraction, name))


def test_written_anew_it_is_the_same_profile_of_the_present_version(
    version: int, profile: Profile, tmp_path: Path
) -> None:
    write_profile(tmp_path / "again", profile)
    assert_same(read_profile(tmp_path / "again"), profile)
    migrate_profile(STORED[version], tmp_path / "p.zip")
    with zipfile.ZipFile(tmp_path / "p.zip") as archive:
        assert json.loads(archive.read("profile.json"))["version"] == VERSION


def broken(
    version: int,
    file: Path,
    change: Callable[[JsonObject], object] = lambda _: None,
    damaged: str = "",
    left_out: str = "",
) -> Path:
    """A copy whose JSON is changed, of one file of which a byte is changed, and which lacks another."""
    document = document_of(version)
    change(document)
    with zipfile.ZipFile(STORED[version]) as whole, zipfile.ZipFile(file, "w") as copy:
        for name in whole.namelist():
            content = json.dumps(document).encode() if name == "profile.json" else whole.read(name)
            if name == damaged:
                content = content[:-1] + bytes([content[-1] ^ 1])
            if name != left_out:
                copy.writestr(name, content)
    return file


def test_a_copy_that_nothing_broke_is_read(version: int, profile: Profile, tmp_path: Path) -> None:
    assert_same(read_profile(broken(version, tmp_path / "p.zip")), profile)


def without(term: str, name: str) -> Callable[[JsonObject], object]:
    def change(document: JsonObject) -> None:
        section = document["terms"][term]
        kept = [one for one in section["parameters"] if one["name"] != name]
        assert len(kept) == len(section["parameters"]) - 1
        section["parameters"] = kept

    return change


CHANGED: Final[dict[str, tuple[Callable[[JsonObject], object], str]]] = {
    "a future version": (lambda d: d.update(version=VERSION + 1), f"newer version {VERSION + 1}"),
    "a version without a number": (lambda d: d.update(version=None), "version number"),
    "a later version than it is": (
        lambda d: d.update(version=VERSION),
        "nonlinearity|captures.steps|depth_ratio|slant",
    ),
    "no term": (lambda d: d["terms"].pop("psf"), "'terms.psf'"),
    "no fit": (lambda d: d["terms"]["wire"].pop("fit"), "'terms.wire.fit'"),
    "no captures": (lambda d: d["terms"]["noise"]["fit"].pop("captures"), "captures"),
    "no blur": (without("psf", "diffraction.blur_px"), "blur_px"),
    "no gain": (without("noise", "K_DN_per_e"), "K_DN_per_e"),
    "another checksum": (lambda d: d["terms"]["backscatter"]["arrays"][0].update(sha256="0" * 64), "SHA-256"),
    "a number out of range": (lambda d: d["terms"]["noise"]["parameters"][1].update(value=-1e9), "black_DN"),
}


@pytest.mark.parametrize("fault", CHANGED)
def test_a_broken_one_is_a_sentence(version: int, fault: str, tmp_path: Path) -> None:
    change, words = CHANGED[fault]
    with pytest.raises(ProfileError, match=words):
        read_profile(broken(version, tmp_path / "p.zip", change))


def test_a_version_that_it_is_past_is_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(ProfileError, match=r"once, found 'diffraction\.blur_growth' twice"):
        read_profile(broken(4, tmp_path / "p.zip", lambda d: d.update(version=3)))


@pytest.mark.parametrize("name", ["wire_map.exr", "backscatter_mask.exr", "psf_residuals.exr"])
def test_a_damaged_or_missing_file_is_a_sentence(version: int, name: str, tmp_path: Path) -> None:
    with pytest.raises(ProfileError, match="SHA-256"):
        read_profile(broken(version, tmp_path / "damaged.zip", damaged=name))
    with pytest.raises(ProfileError, match=f"Expected the file {name}"):
        read_profile(broken(version, tmp_path / "less.zip", left_out=name))
