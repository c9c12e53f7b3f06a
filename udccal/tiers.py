"""Tiers of restoration: the same stages, more of them for more accuracy."""

from __future__ import annotations

import enum
from typing import Final

from udccal.errors import RestorationError


class Tier(enum.StrEnum):
    """How much is done to a frame, from quickest to most accurate. docs/restoration.md has seconds and dB of each.

    ``preview``: black level, wire, backscatter of the panel's mean, demosaicing, geometry; no deblurring.
    ``fast``: backscatter of the panel's picture; demosaicing and deblurring in one linear filter per tile, each with
    the prior that its samples make likeliest.
    ``balanced``: also takes out noise band by band.
    ``accurate``: lets a small network take out noise, and find edges that the filter loses.
    """

    preview = "preview"
    fast = "fast"
    balanced = "balanced"
    accurate = "accurate"


# What is done where nobody asks for anything else.
DEFAULT_TIER: Final = Tier.balanced


def tier_named(tier: Tier | str) -> Tier:
    """Return the tier of a name.

    Raises:
        RestorationError: when there is no such tier.
    """
    try:
        return Tier(tier)
    except ValueError:
        names = ", ".join(Tier)
        raise RestorationError(f"Expected a tier, found {tier!r}. Give one of {names}.") from None
