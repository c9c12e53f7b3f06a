"""Units of parameters, from the suffixes of their names (docs/conventions.md)."""

from __future__ import annotations

# Longest suffixes first: the first match decides.
_SUFFIXES = (
    ("_periods", "period"),
    ("_e_per_s", "e-/s"),
    ("_DN_per_e", "DN/e-"),
    ("_per_px", "1/px"),
    ("_per_mm", "1/mm"),
    ("_deg", "deg"),
    ("_rad", "rad"),
    ("_px", "px"),
    ("_mm", "mm"),
    ("_um", "um"),
    ("_nm", "nm"),
    ("_DN", "DN"),
    ("_e", "e-"),
    ("_s", "s"),
)


def unit_of(name: str) -> str:
    """Return the unit of a parameter by its (dotted) name; ``1`` where the name has no unit."""
    parts = [part for part in name.split(".") if not part.isdigit()]
    own = parts[-1] if parts else name
    return next((unit for suffix, unit in _SUFFIXES if own.endswith(suffix)), "1")
