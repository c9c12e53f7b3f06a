"""Descriptions of a rig that were written in older words."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from udccal.errors import RigError
from udccal.rig import RigDescription, load_rig
from udccal.rig_folders import find_rig
from udccal.rig_versions import present_rig

OLD_WORDS = {
    "row_open": "row_open_fraction",
    "column_open": "column_open_fraction",
    "depth_mm": "structure_thickness_mm",
}


def rig_file(folder: Path, version: str, words: dict[str, str]) -> Path:
    """The shipped mirror's rig.toml with another version and other names."""
    text = (find_rig("lg55-aca2040") / "rig.toml").read_text().replace("version = 2", f"version = {version}")
    for present, old in words.items():
        text = text.replace(f"\n{present} =", f"\n{old} =")
    (folder / "rig.toml").write_text(text)
    return folder


def test_version_1_is_read_as_the_same_rig(tmp_path: Path) -> None:
    assert load_rig(rig_file(tmp_path, "1", OLD_WORDS)) == load_rig("lg55-aca2040")


@pytest.mark.parametrize(
    ("version", "words", "says"),
    [
        ("3", {}, "version"),
        ("0", {}, "version"),
        ("true", OLD_WORDS, "version"),
        ("2", OLD_WORDS, "row_open"),
        ("1", {"row_open": "rows_open"}, "row_open"),
    ],
)
def test_other_versions_and_mixed_words_are_refused(
    tmp_path: Path, version: str, words: dict[str, str], says: str
) -> None:
    with pytest.raises(RigError, match=says):
        load_rig(rig_file(tmp_path, version, words))


@pytest.mark.parametrize("found", [None, [], 1, {}, {"version": 1}, {"version": 1, "panel": []}, {"version": [1]}])
def test_what_is_no_description_is_left_to_the_schema(found: object) -> None:
    with pytest.raises(ValueError, match="RigDescription"):
        RigDescription.model_validate(present_rig(found))


def test_toml_of_the_shipped_rigs_is_of_the_present_version() -> None:
    for name in ("lg55-aca2040", "lg55-reduced", "mk31-imx1600"):
        assert tomllib.loads((find_rig(name) / "rig.toml").read_text())["version"] == 2
