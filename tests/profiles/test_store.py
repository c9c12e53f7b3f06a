from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

import jax
import numpy as np
import pytest
from pydantic import ValidationError

from udccal.errors import FileFormatError, FitError, ProfileError
from udccal.io.exr import write_exr
from udccal.io.hashing import sha256_file
from udccal.profiles.profile import Profile, build_profile
from udccal.profiles.provenance import PROFILE_NAME, profile_sha256
from udccal.profiles.schema import VERSION, PictureName, StoredProfile
from udccal.profiles.store import (
    RIG_PROFILE,
    check_replaceable,
    find_profile,
    read_profile,
    read_stored,
    write_profile,
)
from udccal.result import FitStatus
from udccal.rig import load_rig
from udccal.rig_folders import shipped_rig_folder

ARRAYS = ("term", "cov", "residuals", "map_sigma")
TERMS = ("noise", "geometry", "wire", "psf", "backscatter")


def assert_same(a: Profile, b: Profile) -> None:
    for name in TERMS:
        one, other = a.result(name), b.result(name)
        assert jax.tree.structure(one.term) == jax.tree.structure(other.term)
        for x, y in zip(jax.tree.leaves(one.term), jax.tree.leaves(other.term), strict=True):
            np.testing.assert_array_equal(x, y)
            assert np.asarray(x).dtype == np.asarray(y).dtype
        plain = [field.name for field in dataclasses.fields(one) if field.name not in ARRAYS]
        assert [getattr(one, name) for name in plain] == [getattr(other, name) for name in plain]
        np.testing.assert_array_equal(one.cov, other.cov)
        assert (one.residuals is None) == (other.residuals is None)
        if one.residuals is not None and other.residuals is not None:
            np.testing.assert_array_equal(one.residuals.positions_px, other.residuals.positions_px)
            np.testing.assert_array_equal(one.residuals.z, other.residuals.z)
        assert (one.map_sigma is None) == (other.map_sigma is None)
        if one.map_sigma is not None:
            np.testing.assert_array_equal(one.map_sigma, other.map_sigma)
    np.testing.assert_array_equal(a.wire_map, b.wire_map)
    np.testing.assert_array_equal(a.backscatter_mask, b.backscatter_mask)
    assert (a.rig, a.provenance, a.parent, a.invalidated_by) == (b.rig, b.provenance, b.parent, b.invalidated_by)


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory, toy_profile: Profile) -> Path:
    folder = tmp_path_factory.mktemp("original") / "p"
    write_profile(folder, toy_profile)
    return folder


@pytest.fixture
def stored(tmp_path: Path, original: Path) -> Path:
    return Path(shutil.copytree(original, tmp_path / "p"))


@pytest.mark.parametrize("name", ["p", "p.zip"])
def test_everything_comes_back_bit_for_bit(tmp_path: Path, toy_profile: Profile, name: str) -> None:
    write_profile(tmp_path / name, toy_profile)
    assert_same(read_profile(tmp_path / name), toy_profile)
    assert read_profile(str(tmp_path / name)).parent == toy_profile.parent
    assert [item.name for item in tmp_path.iterdir()] == [name]


def test_geometry_is_stored_once(stored: Path) -> None:
    sections = json.loads((stored / PROFILE_NAME).read_text())["terms"]
    kinds = {name: [p["kind"] for p in sections[name]["parameters"]] for name in TERMS}
    assert all("reference" in kinds[name] for name in ("wire", "psf", "backscatter"))
    assert "reference" not in kinds["geometry"]


def test_a_term_with_another_geometry_keeps_it(tmp_path: Path, toy_profile: Profile) -> None:
    wire = toy_profile.wire.term
    geometry = type(wire.geometry)(**{**vars(wire.geometry), "pupil_mm": np.array([1.0, 2.0, -3.0])})
    other = type(wire)(**{**vars(wire), "geometry": geometry})
    changed = dataclasses.replace(toy_profile, wire=dataclasses.replace(toy_profile.wire, term=other))
    write_profile(tmp_path / "p", changed)
    assert_same(read_profile(tmp_path / "p"), changed)


def test_a_fitted_parameter_carries_unit_and_sigma(stored: Path) -> None:
    parameters = {p["name"]: p for p in json.loads((stored / PROFILE_NAME).read_text())["terms"]["noise"]["parameters"]}
    assert (parameters["K_DN_per_e"]["unit"], parameters["K_DN_per_e"]["sigma"]) == ("DN/e-", 1e-3)
    assert (parameters["sigma_d_e"]["unit"], parameters["sigma_d_e"]["sigma"]) == ("e-", None)


def test_a_profile_is_replaced_whole(stored: Path, toy_profile: Profile) -> None:
    child = dataclasses.replace(toy_profile, parent=profile_sha256(stored))
    write_profile(stored, child)
    assert read_profile(stored).parent == child.parent
    assert [item.name for item in stored.parent.iterdir()] == ["p"]


def test_a_folder_with_anything_else_is_left_alone(stored: Path, toy_profile: Profile) -> None:
    (stored / "rig.toml").write_text("mine")
    with pytest.raises(ProfileError, match=r"found 'rig.toml' too"):
        write_profile(stored, toy_profile)
    other = stored.parent / "holiday"
    other.mkdir()
    (other / "photo.png").write_text("mine")
    with pytest.raises(ProfileError, match="Choose another path"):
        write_profile(other, toy_profile)
    assert (other / "photo.png").read_text() == "mine"


@pytest.mark.parametrize("place", [".", "..", "/"])
def test_a_place_without_a_name_is_refused_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: str
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ProfileError, match="Give the profile a name"):
        check_replaceable(Path(place))


def test_a_path_that_is_no_text_is_refused_before_any_work(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="in UTF-8, found other bytes"):
        check_replaceable(tmp_path / "p\udcff")


def test_a_file_of_a_profile_is_not_taken_for_a_zip_file(stored: Path) -> None:
    with pytest.raises(ProfileError, match="one of its files"):
        read_profile(stored / PROFILE_NAME)


def test_a_failed_write_leaves_nothing(tmp_path: Path, toy_profile: Profile) -> None:
    broken = dataclasses.replace(toy_profile.noise, chi2_dof=float("nan"))
    with pytest.raises(ProfileError, match="chi2_dof"):
        write_profile(tmp_path / "p", dataclasses.replace(toy_profile, noise=broken))
    assert list(tmp_path.iterdir()) == []


def test_a_bad_fit_makes_no_profile(toy_profile: Profile) -> None:
    results = {name: toy_profile.result(name) for name in TERMS}
    results["wire"] = dataclasses.replace(results["wire"], status=FitStatus.SATURATED)
    with pytest.raises(FitError, match="SATURATED"):
        build_profile(toy_profile.rig, toy_profile.provenance, **results, wire_map=toy_profile.wire_map)


def damaged(change: Callable[[dict[str, Any]], object]) -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        document = json.loads((folder / PROFILE_NAME).read_text())
        change(document)
        (folder / PROFILE_NAME).write_text(json.dumps(document))

    return apply


def parameter(document: dict[str, Any], term: str, name: str) -> dict[str, Any]:
    return next(p for p in document["terms"][term]["parameters"] if p["name"] == name)


def array_of(document: dict[str, Any]) -> dict[str, Any]:
    return document["terms"]["psf"]["arrays"][0]


def noise_fit(document: dict[str, Any]) -> dict[str, Any]:
    return document["terms"]["noise"]["fit"]


def black_level(document: dict[str, Any]) -> dict[str, Any]:
    return noise_fit(document)["estimates"][1]


FAR = {
    "kind": "numbers", "name": "residuals", "dtype": "float32", "shape": [1, 3], "value": [2e5, 0.0, 0.0],
    "unit": "px, px, 1", "sigma": None,
}  # fmt: skip


def sigma_map(folder: Path, value: float) -> None:
    """Write another map of the wire's sigma, with its checksum."""
    write_exr(folder / "wire_sigma.exr", {"sigma": np.full((3, 4), value, np.float32)})
    damaged(lambda d: d["pictures"][3].update(sha256=sha256_file(folder / "wire_sigma.exr")))(folder)


DAMAGES: dict[str, tuple[Callable[[Path], object], str]] = {
    "no profile.json": (lambda f: (f / PROFILE_NAME).unlink(), "found none"),
    "cut short": (lambda f: (f / PROFILE_NAME).write_bytes((f / PROFILE_NAME).read_bytes()[:500]), "to be JSON"),
    "not an object": (lambda f: (f / PROFILE_NAME).write_text("[1]"), "JSON object"),
    "newer": (damaged(lambda d: d.update(version=VERSION + 1)), f"newer version {VERSION + 1}"),
    "another format": (damaged(lambda d: d.update(format="udccal-session")), "format 'udccal-profile'"),
    "unknown entry": (damaged(lambda d: d.update(extra=1)), "'extra'"),
    "missing entry": (damaged(lambda d: d.pop("rig")), "'rig'"),
    "not a number": (damaged(lambda d: parameter(d, "noise", "black_DN").update(value=float("nan"))), "value"),
    "wrong type": (damaged(lambda d: parameter(d, "noise", "black_DN").update(value="64")), "value"),
    "missing parameter": (damaged(lambda d: d["terms"]["noise"]["parameters"].pop()), "found none"),
    "unknown parameter": (damaged(lambda d: parameter(d, "noise", "q_DN").update(name="os")), "found none"),
    "wrong shape": (damaged(lambda d: parameter(d, "geometry", "focal_px").update(shape=[3])), "3 values"),
    "another model": (damaged(lambda d: d["terms"]["wire"].update(model="Path")), "found 'Path'"),
    "another nested model": (
        damaged(lambda d: parameter(d, "psf", "diffraction").update(model="Popen")), "found 'Popen'"
    ),
    "unknown status": (damaged(lambda d: d["terms"]["wire"]["fit"].update(status="FINE")), "found 'FINE'"),
    "path escape": (damaged(lambda d: array_of(d).update(file="../psf_residual.exr")), "file"),
    "absolute path": (damaged(lambda d: array_of(d).update(file="/etc/passwd")), "file"),
    "wrong size of an array": (damaged(lambda d: array_of(d).update(shape=[1, 3, 15, 14])), "samples"),
    "array missing": (lambda f: (f / "psf_residual.exr").unlink(), "found none"),
    "array changed": (lambda f: (f / "psf_residual.exr").write_bytes(b"x"), "SHA-256"),
    "wire map missing": (lambda f: (f / "wire_map.exr").unlink(), "found none"),
    "a prior narrower than 0": (damaged(lambda d: black_level(d)["prior"].update(sigma=-0.1)), "sigma"),
    "a prior that is no number": (damaged(lambda d: black_level(d)["prior"].update(value=float("inf"))), "value"),
    "no word of what it is": (damaged(lambda d: black_level(d).pop("what")), "what"),
    "outliers below none": (damaged(lambda d: noise_fit(d)["outliers"][0].update(count=-1)), "count"),
    "residuals of two columns": (damaged(lambda d: noise_fit(d)["residuals"].update(shape=[3, 2])), "shape"),
    "residuals far away": (damaged(lambda d: noise_fit(d).update(residuals=FAR)), "within"),
    "a short digest": (damaged(lambda d: noise_fit(d)["captures"].update(sha256="ab")), "sha256"),
    "a short digest of a step": (damaged(lambda d: noise_fit(d)["captures"].update(steps=["ab"])), "steps"),
    "no frames": (damaged(lambda d: noise_fit(d)["captures"].update(frames=0)), "frames"),
    "gains in the wrong order": (damaged(lambda d: noise_fit(d)["captures"].update(gain_dB=[6.0, 0.0])), "lower"),
    "too cold": (damaged(lambda d: noise_fit(d)["captures"].update(temperature_C=[-300.0, 0.0])), "temperature_C"),
    "another effort": (damaged(lambda d: noise_fit(d).update(effort="some")), "effort"),
    "no evidence": (damaged(lambda d: noise_fit(d).pop("captures")), "captures"),
    "a sigma below 0": (lambda f: sigma_map(f, -1e-4), "values from 0"),
    "a sigma of another size": (damaged(lambda d: d["pictures"][3].update(rows=5)), "samples"),
    "picture not listed": (damaged(lambda d: d["pictures"].pop(0)), "found none"),
}  # fmt: skip


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_profile_is_refused_with_a_sentence(stored: Path, damage: str) -> None:
    apply, message = DAMAGES[damage]
    apply(stored)
    with pytest.raises(ProfileError, match=message):
        read_profile(stored)


def test_a_link_out_of_the_folder_is_refused(stored: Path) -> None:
    (stored / "wire_map.exr").rename(stored.parent / "elsewhere.exr")
    (stored / "wire_map.exr").symlink_to(stored.parent / "elsewhere.exr")
    with pytest.raises(ProfileError, match="found none"):
        read_profile(stored)


def test_a_profile_has_room_for_every_kind_of_picture_once(stored: Path) -> None:
    form = read_stored(stored).model_dump()
    one, names = form["pictures"][0], get_args(PictureName)
    form["pictures"] = [{**one, "name": name} for name in names]
    assert len(StoredProfile.model_validate(form).pictures) == len(names)
    with pytest.raises(ValidationError, match="at most"):
        StoredProfile.model_validate({**form, "pictures": [*form["pictures"], one]})


def test_the_stored_form_can_be_read_without_its_arrays(stored: Path, toy_profile: Profile) -> None:
    (stored / "psf_residual.exr").unlink()
    assert read_stored(stored).rig == toy_profile.rig


def test_profiles_are_found_by_path_and_by_name(
    tmp_path: Path, original: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mine = tmp_path / "rigs" / "mine"
    shutil.copytree(shipped_rig_folder() / "lg55-reduced", mine, ignore=shutil.ignore_patterns(RIG_PROFILE))
    monkeypatch.setenv("UDCCAL_RIGS", str(mine.parent))
    assert find_profile(original) == original
    with pytest.raises(ProfileError, match=r"Expected a profile .* found none"):
        read_profile(find_profile("mine"))
    with pytest.raises(ProfileError, match=r"name a rig that has one: lg55-reduced\.$"):
        read_profile(find_profile("no-such-rig"))
    shutil.copytree(original, mine / RIG_PROFILE)
    with pytest.raises(ProfileError, match=r"name a rig that has one: mine, lg55-reduced\.$"):
        read_profile(find_profile("no-such-rig"))
    assert find_profile("mine") == mine / RIG_PROFILE


def test_a_folder_named_as_a_rig_does_not_hide_its_profile(
    tmp_path: Path, stored: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in the folder of all rigs."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "lg55-reduced").mkdir()
    shipped = shipped_rig_folder() / "lg55-reduced" / RIG_PROFILE
    assert find_profile("lg55-reduced") == shipped
    shutil.rmtree("lg55-reduced")
    shutil.copytree(stored, "lg55-reduced")
    assert find_profile("lg55-reduced") == Path("lg55-reduced")


def test_the_shipped_profile_is_of_the_shipped_rig() -> None:
    profile = read_profile(find_profile("lg55-reduced"))
    assert profile.rig == load_rig("lg55-reduced")
    assert {profile.result(term).status for term in TERMS} == {FitStatus.CONVERGED}
    assert "udccal calibrate --rig lg55-reduced" in profile.provenance.command
