"""Tiers of restoration: the same stages, more of them for more accuracy."""

from __future__ import annotations

import enum


class Tier(enum.StrEnum):
    """How much is done to a frame, from quickest to most accurate. docs/restoration.md has seconds and dB of each.

    ``preview``: black level, wire, backscatter of the panel's mean, demosaicing, geometry; no deblurring.
    ``fast``: backscatter of the panel's picture; demosaicing and deblurring in one linear filter per tile, each with
    the prior that its samples make likeliest.
    ``balanced``: also takes out noise band by band.
    """

    preview = "preview"
    fast = "fast"
    balanced = "balanced"
