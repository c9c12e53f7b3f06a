"""The reduced rig made eight times smaller, for tests of whole commands."""

from __future__ import annotations

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
