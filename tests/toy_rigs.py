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

# Enough pixels for the corners of a board, captures that every fit can use, and the part of the panel that is seen.
_FIVE_TERMS = {
    "columns = 128": "columns = 256",
    "rows = 96": "rows = 192",
    "pitch_um = 55.2": "pitch_um = 27.6",
    "flats = 100": "flats = 16",
    # An image two pixels wide: of a point within one pixel, neither exposure nor place can be told.
    "psf_led_mm = 2.3": "psf_led_mm = 18.4",
    "psf_rows = 3": "psf_rows = 1",
    "psf_shifts = 3": "psf_shifts = 2",
    "psf_exposures = 6": "psf_exposures = 3",
    "psf_region_columns = 16": "psf_region_columns = 24",
    "psf_region_rows = 32": "psf_region_rows = 64",
    "backscatter_pictures = 8": "backscatter_pictures = 6",
    "backscatter_frames = 4": "backscatter_frames = 2",
    "board_views = 6": "board_views = 4",
    "columns = 1920": "columns = 240",
    "rows = 1080": "rows = 136",
    "panel_x_px = { value = 960.0": "panel_x_px = { value = 120.0",
    "panel_y_px = { value = 300.0": "panel_y_px = { value = 60.0",
}

# The emulated camera of Basler's SDK has this many pixels across and down.
_EMULATED = {"columns = 128": "columns = 4096", "rows = 96": "rows = 4096", "pitch_um = 55.2": "pitch_um = 1.725"}


def write_emulated_rig(folder: Path) -> Path:
    """The toy rig with the sensor of the camera that Basler's SDK emulates; returns the rig's folder."""
    rig = write_toy_rig(folder)
    change_rig(rig, _EMULATED)
    return rig


def write_five_term_rig(folder: Path) -> Path:
    """A toy rig of which all five terms can be captured and fitted in a minute or two; returns the rig's folder."""
    rig = write_toy_rig(folder)
    change_rig(rig, _FIVE_TERMS)
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
