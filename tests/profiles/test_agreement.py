"""A profile in which one of a number's two places was edited is refused, on reading and on writing."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from udccal.errors import ProfileError
from udccal.profiles.agreement import check_agreement
from udccal.profiles.profile import Profile
from udccal.profiles.provenance import PROFILE_NAME
from udccal.profiles.store import read_profile, write_profile
from udccal.result import Estimate
from udccal.rig_folders import shipped_rig_folder

SHIPPED = shipped_rig_folder() / "lg55-reduced" / "profile"


@pytest.fixture(scope="module")
def measured() -> Profile:
    return read_profile(SHIPPED)


def edited(folder: Path, term: str, name: str, at: int | None, factor: float) -> Path:
    """The shipped profile with one of a term's parameters multiplied."""
    shutil.copytree(SHIPPED, folder)
    document: dict[str, Any] = json.loads((folder / PROFILE_NAME).read_text())
    (found,) = (one for one in document["terms"][term]["parameters"] if one["name"] == name)
    if at is None:
        found["value"] *= factor
    else:
        found["value"][at] *= factor
    (folder / PROFILE_NAME).write_text(json.dumps(document))
    return folder


@pytest.mark.parametrize(
    ("term", "name", "at", "factor", "estimate"),
    [
        ("noise", "K_DN_per_e", None, 1.001, "K_DN_per_e"),
        ("geometry", "focal_px", 1, 1.001, "fy"),
        ("wire", "offset_periods", 0, 0.9, "offset_x_periods"),
        ("wire", "baseline", 2, 1.001, "baseline.0.2"),
        ("psf", "diffraction.openings", 0, 0.99, "column_open"),
    ],
)
def test_an_edited_parameter_is_refused(
    tmp_path: Path, term: str, name: str, at: int | None, factor: float, estimate: str
) -> None:
    folder = edited(tmp_path / "p", term, name, at, factor)
    with pytest.raises(ProfileError, match=rf"Expected the {term} term to have its fit's {estimate} of .*, found"):
        read_profile(folder)


def test_what_could_not_be_read_is_not_written(tmp_path: Path, measured: Profile) -> None:
    noise = replace(measured.noise.term, K_DN_per_e=2 * float(measured.noise.term.K_DN_per_e))
    with pytest.raises(ProfileError, match="K_DN_per_e"):
        write_profile(tmp_path / "p", replace(measured, noise=replace(measured.noise, term=noise)))
    assert not list(tmp_path.iterdir())


def test_whole_periods_count_as_none(measured: Profile) -> None:
    wire = measured.wire.term
    check_agreement(replace(measured.wire, term=replace(wire, offset_periods=wire.offset_periods - 3.0)))


@pytest.mark.parametrize("name", ["", "rotation_x_deg", "geometry", "baseline", "baseline.0.99999", "baseline.x.0"])
def test_other_names_are_passed_over(measured: Profile, name: str) -> None:
    check_agreement(replace(measured.wire, estimates=(Estimate(name, 7.0, 1.0, "1"),)))
