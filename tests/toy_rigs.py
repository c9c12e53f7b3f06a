"""The reduced rig made eight times smaller, for tests of whole commands."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

RIGS = Path(__file__).resolve().parents[1] / "rig_profiles"
_CHANGES = {
    'name = "lg55-reduced"': 'name = "toy"',
    "columns = 1024": "columns = 128",
    "rows = 768": "rows = 96",
    "pitch_um = 6.9": "pitch_um = 55.2",
    "noise_levels = 10": "noise_levels = 5",
    "noise_stack = 8": "noise_stack = 2",
    "psf_region_columns = 48": "psf_region_columns = 16",
    "psf_region_rows = 144": "psf_region_rows = 32",
    "[view]\ncolumns = 960\nrows = 540": "[view]\ncolumns = 120\nrows = 68",
}


# The emulated camera of Basler's SDK has this many pixels across and down.
_EMULATED = {"columns = 128": "columns = 4096", "rows = 96": "rows = 4096", "pitch_um = 55.2": "pitch_um = 1.725"}


def write_emulated_rig(folder: Path) -> Path:
    """The toy rig with the sensor of the camera that Basler's SDK emulates; returns the rig's folder."""
    rig = write_toy_rig(folder)
    change_rig(rig, _EMULATED)
    return rig


def change_rig(rig: Path, changes: Mapping[str, str]) -> None:
    """Replace parts of a rig's description that it has exactly once."""
    text = (rig / "rig.toml").read_text(encoding="utf-8")
    for old, new in changes.items():
        if text.count(old) != 1:
            raise ValueError(f"expected '{old}' once in the rig's description, found it {text.count(old)} times")
        text = text.replace(old, new)
    (rig / "rig.toml").write_text(text, encoding="utf-8")


def write_toy_rig(folder: Path) -> Path:
    """The same field of view with an eighth of the pixels across and few captures; returns the rig's folder."""
    text = (RIGS / "lg55-reduced" / "rig.toml").read_text(encoding="utf-8")
    for old, new in _CHANGES.items():
        if old not in text:
            raise ValueError(f"expected '{old}' in the reduced rig's description, found none")
        text = text.replace(old, new)
    rig = folder / "toy"
    rig.mkdir()
    (rig / "rig.toml").write_text(text, encoding="utf-8")
    return rig
