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


@pytest.mark.parametrize(
    ("right", "wrong", "says"),
    [
        (
            "focal_mm = { value = 6.0, tolerance = 0.1 }",
            "focal_mm = 6.0",
            "'lens.focal_mm' .* found 6.0 without a tolerance, where { value = 6.0, tolerance = ... } belongs",
        ),
        ("focus_mm = 2000.0", "", "'lens.focus_mm' .* found none. Correct"),
        ("focus_mm = 2000.0", "focus_mm = 2000.0\nfocus_m = 2.0", "'lens.focus_m' .* found a name that a rig does not"),
        ("bits = 12", "bits = 99", "'camera.bits' .* found 99: it should be less than or equal to 16"),
        ("pitch_um = 6.9", "pitch_um = '6,9'", "'camera.pitch_um' .* found '6,9': it should be a valid number"),
        ("bits = 12", "bits = '" + 200 * "9" + "'", "found '9+[.]{3}9+': "),
        ("value = 6.0, tolerance = 0.1", "value = 1e-9, tolerance = 0.1", "found a value of 1e-09, which must be from"),
        ('name = "lg55-reduced"', 'name = "LG"', "'name' .* found 'LG': it should match pattern"),
    ],
)
def test_a_mistake_is_told_with_what_was_found(tmp_path: Path, right: str, wrong: str, says: str) -> None:
    text = (find_rig("lg55-reduced") / "rig.toml").read_text(encoding="utf-8")
    (tmp_path / "rig.toml").write_text(text.replace(right, wrong), encoding="utf-8")
    with pytest.raises(RigError, match=says):
        load_rig(tmp_path)


def test_a_byte_order_mark_is_no_mistake(tmp_path: Path) -> None:
    text = (find_rig("lg55-reduced") / "rig.toml").read_text(encoding="utf-8")
    (tmp_path / "rig.toml").write_text(text, encoding="utf-8-sig")
    assert load_rig(tmp_path) == load_rig("lg55-reduced")


def test_a_number_where_a_section_belongs_is_refused(tmp_path: Path) -> None:
    text = (find_rig("lg55-reduced") / "rig.toml").read_text(encoding="utf-8")
    (tmp_path / "rig.toml").write_text("lens = 3\n" + text.replace("[lens]", "[other]"), encoding="utf-8")
    with pytest.raises(RigError, match=r"'lens' .* found 3, where a section belongs"):
        load_rig(tmp_path)


def test_toml_of_the_shipped_rigs_is_of_the_present_version() -> None:
    for name in ("lg55-aca2040", "lg55-reduced", "mk31-imx1600"):
        assert tomllib.loads((find_rig(name) / "rig.toml").read_text())["version"] == 2
