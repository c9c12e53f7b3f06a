from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from udccal.errors import ProfileError
from udccal.io.exr import read_exr, write_exr
from udccal.io.hashing import sha256_file
from udccal.profiles.profile import Profile
from udccal.profiles.provenance import PROFILE_NAME
from udccal.profiles.ranges import RANGES, Real, Whole, check_term
from udccal.profiles.store import read_profile, write_profile
from udccal.sessions.schema import TermName

# What says so while tests run: their checks of types come before the ranges.
_BY_TYPE = "parameters that make a"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, toy_profile: Profile) -> Path:
    folder = tmp_path_factory.mktemp("profile") / "p"
    write_profile(folder, toy_profile)
    return folder


@pytest.fixture
def document(folder: Path) -> dict[str, Any]:
    return json.loads((folder / PROFILE_NAME).read_text())


def refused(folder: Path, document: dict[str, Any], said: str) -> None:
    whole = (folder / PROFILE_NAME).read_bytes()
    try:
        (folder / PROFILE_NAME).write_text(json.dumps(document))
        with pytest.raises(ProfileError, match=said) as caught:
            read_profile(folder)
    finally:
        (folder / PROFILE_NAME).write_bytes(whole)
    sentence = str(caught.value)
    assert sentence.startswith("Expected ")
    assert "found" in sentence


@pytest.mark.parametrize("model", RANGES)
def test_every_field_has_a_range(model: type) -> None:
    assert list(RANGES[model]) == [field.name for field in dataclasses.fields(model)]


def test_what_tests_write_is_in_range(toy_profile: Profile) -> None:
    for name in ("noise", "geometry", "wire", "psf", "backscatter"):
        check_term(toy_profile.result(name).term, name, toy_profile.rig)


@pytest.mark.parametrize(
    ("term", "name", "value"),
    [
        ("backscatter", "step", 0),
        ("backscatter", "step", 33),
        ("backscatter", "step", 16),
        ("backscatter", "window", 2**40),
        ("backscatter", "window", 0),
        ("backscatter", "window", None),
        ("backscatter", "window", True),
        ("backscatter", "cfa", "XYZW"),
        ("backscatter", "cfa", "BGGR"),
        ("backscatter", "cfa", 7),
        ("backscatter", "rows", 65),
        ("psf", "fine", -3),
        ("psf", "fine", 2**40),
        ("psf", "fine", "8"),
        ("psf", "degree", 3),
        ("psf", "degree", -2),
        ("psf", "degree", 2**62),
    ],
)
def test_choices_out_of_range_are_refused(
    folder: Path, document: dict[str, Any], term: str, name: str, value: object
) -> None:
    next(p for p in document["terms"][term]["parameters"] if p["name"] == name)["value"] = value
    refused(folder, document, rf"'{term}\.|'terms\.{term}\.|{_BY_TYPE}")


def test_a_wrong_shape_is_refused(folder: Path, document: dict[str, Any]) -> None:
    next(p for p in document["terms"]["backscatter"]["parameters"] if p["name"] == "emitters_px")["shape"] = [2, 3]
    refused(folder, document, f"'backscatter.emitters_px' to be real numbers of shape|{_BY_TYPE}")


def leaves(model: type, name: str) -> list[tuple[str, str, Real]]:
    """(section, field, range) of every real number of a term, nested ones too."""
    found = []
    for field, allowed in RANGES[model].items():
        if isinstance(allowed, Real):
            found.append((name, field, allowed))
        elif isinstance(allowed, type) and allowed in RANGES:
            found += leaves(allowed, f"{name}.{field}")
    return found


def numbers() -> list[tuple[str, str, Real]]:
    names = {"Noise": "noise", "Geometry": "geometry", "Wire": "wire", "PsfField": "psf", "Backscatter": "backscatter"}
    return [leaf for model in RANGES if model.__name__ in names for leaf in leaves(model, names[model.__name__])]


def term_of(profile: Profile, name: str) -> Any:
    """A term, or one inside it, by its dotted name; the wire with a harmonic."""
    section, *nested = name.split(".")
    term = profile.result(cast(TermName, section)).term
    for inner in nested:
        term = getattr(term, inner)
    if name != "wire":
        return term
    one = {"harmonics": np.array([[0.0, 1.0]]), "frequency": np.array([[3.0, 1.0]]), "fields": np.zeros((1, 2, 2, 1))}
    return dataclasses.replace(term, **one)


@pytest.mark.parametrize(("name", "field", "allowed"), numbers(), ids=lambda v: v if isinstance(v, str) else "")
def test_numbers_beyond_their_range_are_refused(toy_profile: Profile, name: str, field: str, allowed: Real) -> None:
    term = term_of(toy_profile, name)
    array = np.asarray(getattr(term, field), dtype=np.float64)
    shape = tuple(max(size, 1) for size in array.shape)
    for bad in (np.nan, -np.inf, np.nextafter(allowed.low, -np.inf), np.nextafter(allowed.high, np.inf)):
        wrong = dataclasses.replace(term, **{field: np.full(shape, bad)})
        with pytest.raises(ProfileError, match=rf"Expected '{name}\.{field}' to be"):
            check_term(wrong, name, toy_profile.rig)


TOGETHER = {
    "saturation below black": ("noise", "saturation_DN", np.float64(60.0), "above black_DN"),
    "half a harmonic": ("wire", "harmonics", np.array([[0.0, 1.5]]), "whole numbers"),
    "a range of nothing": ("wire", "frequency", np.array([[3.0, 0.0]]), "half ranges above 0"),
    "amplitudes of no harmonic": ("wire", "amplitudes", np.zeros((3, 2, 1, 1)), "at most the"),
    "a baseline of no degree": ("wire", "baseline", np.zeros((0, 1)), "1 to 64 degrees"),
    "one wavelength": ("psf.diffraction", "wavelengths_nm", np.array([500.0]), "2 to 64 wavelengths"),
    "falling wavelengths": ("psf.diffraction", "wavelengths_nm", np.linspace(700, 400, 4), "even steps"),
    "a dark spectrum": ("psf.diffraction", "spectrum", np.zeros((3, 4)), "sums to 1"),
    "terms of another degree": ("psf", "residual", np.ones((3, 3, 1, 1)), "of the 1 terms"),
    "an even kernel": ("psf", "residual", np.ones((1, 3, 4, 3)), "odd number"),
    "a kernel beyond the sensor": ("psf", "residual", np.ones((1, 3, 67, 3)), "at most the sensor's 64"),
    "another sensor": ("backscatter", "columns", 128, "the rig's, 96"),
    "a mask of another grid": ("backscatter", "mask", np.ones((3, 2, 2)), "3 x 2 values"),
    "too many shares": ("backscatter", "window", 1024 * 1024, "from 1 to 1024"),
    "a bright mix": ("backscatter", "mix", np.full((3, 3), 0.5), "sum to 1"),
}  # fmt: skip


@pytest.mark.parametrize("case", TOGETHER)
def test_numbers_that_do_not_go_together_are_refused(toy_profile: Profile, case: str) -> None:
    name, field, value, said = TOGETHER[case]
    term = term_of(toy_profile, name)
    changes: dict[str, Any] = {field: value}
    if case == "one wavelength":
        changes["spectrum"] = np.ones((3, 1))
    with pytest.raises(ProfileError, match=rf"'{name}\.{field}' to be .*{said}"):
        check_term(dataclasses.replace(term, **changes), name, toy_profile.rig)


def test_a_window_goes_with_a_grid(toy_profile: Profile) -> None:
    term = toy_profile.backscatter.term
    check_term(dataclasses.replace(term, window=1000), "backscatter", toy_profile.rig)
    fine = dataclasses.replace(term, step=1, mask=np.zeros((3, 64, 96)), window=200)
    with pytest.raises(ProfileError, match=r"'backscatter.window' to be at most 104"):
        check_term(fine, "backscatter", toy_profile.rig)


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("panel", "pitch_mm", "value"), 0.0),
        (("lens", "focal_mm", "value"), 1e300),
        (("camera", "pitch_um"), 1e-300),
        (("camera", "K_DN_per_e", "tolerance"), 1e300),
        (("camera", "cfa"), "XYZW"),
        (("view",), {"columns": 16384, "rows": 16384}),
        (("captures", "flats"), 10**400),
        (("captures", "noise_levels"), 10**9),
        (("captures", "board_views"), 10**8),
        (("captures",), {"psf_columns": 100, "psf_rows": 100, "psf_shifts": 2}),
    ],
)
def test_a_rig_out_of_range_is_refused(folder: Path, document: dict[str, Any], path: Any, value: object) -> None:
    *way, last = path
    holder = document["rig"]
    for key in way:
        holder = holder[key]
    holder[last] = value
    refused(folder, document, rf"'rig\.{path[0]}")


@pytest.mark.parametrize(
    ("shape", "dtype", "value"), [([0, 2**24, 2**24, 2**24], "float64", []), ([1], "float32", [1e300])]
)
def test_arrays_that_no_memory_or_type_holds_are_refused(
    folder: Path, document: dict[str, Any], shape: object, dtype: str, value: object
) -> None:
    entry = next(p for p in document["terms"]["wire"]["parameters"] if p["name"] == "amplitudes")
    entry.update(shape=shape, dtype=dtype, value=value)
    refused(folder, document, "'amplitudes' to hold finite numbers")


def test_a_group_of_another_model_is_refused(folder: Path, document: dict[str, Any]) -> None:
    parameters = document["terms"]["psf"]["parameters"]
    document["terms"]["psf"]["parameters"] = [
        {"kind": "reference", "name": "diffraction", "section": "geometry"} if p["name"] == "diffraction" else p
        for p in parameters
        if not p["name"].startswith("diffraction.")
    ]
    refused(folder, document, "Diffraction|a PsfField")


@pytest.mark.parametrize(("name", "value"), [("wire_map", 0.0), ("wire_map", 1e6), ("backscatter_white", 1e20)])
def test_maps_out_of_range_are_refused(tmp_path: Path, folder: Path, name: str, value: float) -> None:
    copy = Path(shutil.copytree(folder, tmp_path / "p"))
    channels = {channel: plane.copy() for channel, plane in read_exr(copy / f"{name}.exr").items()}
    next(iter(channels.values()))[3, 4] = value
    write_exr(copy / f"{name}.exr", channels)
    document = json.loads((copy / PROFILE_NAME).read_text())
    next(p for p in document["pictures"] if p["name"] == name)["sha256"] = sha256_file(copy / f"{name}.exr")
    refused(copy, document, "Expected values from")


def test_whole_ranges_are_ranges() -> None:
    for ranges in RANGES.values():
        assert all(r.low < r.high for r in ranges.values() if isinstance(r, Real | Whole))
