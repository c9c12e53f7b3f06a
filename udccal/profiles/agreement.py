"""A fitted number stands twice in a profile: as a parameter of its term, and as an estimate of the fit."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from udccal.errors import ProfileError
from udccal.result import FitResult

# Where the term has an estimate of another name. Backscatter's estimates are means over the posterior, its term is not.
_PLACES: Final[Mapping[str, Mapping[str, str]]] = MappingProxyType(
    {
        "noise": {},
        "geometry": {
            name: f"{field}.{i}"
            for field, names in (
                ("focal_px", ("fx", "fy")),
                ("principal_point_px", ("cx", "cy")),
                ("distortion", ("k1", "k2", "p1", "p2", "k3")),
            )
            for i, name in enumerate(names)
        },
        "wire": {"offset_x_periods": "offset_periods.0", "offset_y_periods": "offset_periods.1"},
        "psf": {
            "column_open": "openings.0",
            "row_open": "openings.1",
            "blur_growth_radial": "blur_growth.0",
            "blur_growth_tangential": "blur_growth.1",
            "blur_red": "blur_colour.0",
            "blur_blue": "blur_colour.2",
            "column_bar_width": "bar_width.0",
            "row_bar_width": "bar_width.1",
            "column_slant": "slant.0",
            "row_slant": "slant.1",
        },
    }
)
# Sums and exponentials of the same numbers round differently.
_RELATIVE, _ABSOLUTE = 1e-6, 1e-9


def check_agreement(result: FitResult) -> None:
    """Refuse a term whose numbers are not those of its fit's estimates, as after an edit of one of the two.

    Args:
        result: of any term. An estimate that is no parameter of the term is passed over.

    Raises:
        ProfileError: which names the number and both of its values.
    """
    if (places := _PLACES.get(result.name)) is None:
        return
    term = result.term.diffraction if result.name == "psf" else result.term
    for one in result.estimates:
        held = _value(term, places.get(one.name, one.name))
        if held is None:
            continue
        apart = held - one.value
        if one.unit == "period":  # whole ones are not seen
            apart -= round(apart)
        if abs(apart) > _RELATIVE * abs(one.value) + _ABSOLUTE:
            raise ProfileError(
                f"Expected the {result.name} term to have its fit's {one.name} of {one.value:.6g}, found {held:.6g}: "
                "one of the two was changed after the fit. Restore the profile from a copy."
            )


def _value(term: Any, place: str) -> float | None:
    """The number at a place such as ``baseline.0.2``; None where the term has none there."""
    field, *index = place.split(".")
    held = np.asarray(getattr(term, field, None))
    try:
        return float(held[tuple(map(int, index))]) if held.dtype.kind == "f" and held.ndim == len(index) else None
    except (ValueError, IndexError):  # the name stands in a file, which may be anything
        return None
