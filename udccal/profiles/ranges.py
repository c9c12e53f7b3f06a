"""Ranges of the numbers of a term: every value that a fit can choose and that is physically sensible.

A profile is a file like any other. Its numbers set the sizes of arrays, occur in divisions, and determine how long
restoration takes. All of them are checked when a profile is read: each against its own range, and some against others.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from udccal.errors import ProfileError
from udccal.models.backscatter import Backscatter
from udccal.models.diffraction import Diffraction
from udccal.models.fields import polynomial_terms
from udccal.models.geometry import Geometry
from udccal.models.noise import Noise
from udccal.models.psf import PsfField
from udccal.models.wire import HIGHEST_ORDER, Wire
from udccal.rig import RigDescription

_ADVICE = "Restore the profile from a copy, or calibrate the rig again."
# Largest number of fractions of emitters in a term: two gigabytes in double precision.
_MOST_SHARES = 2**26


@dataclass(frozen=True)
class Real:
    """Real numbers from ``low`` to ``high``; a name in ``shape`` stands for one size throughout a term."""

    low: float
    high: float
    shape: tuple[int | str, ...] = ()


@dataclass(frozen=True)
class Whole:
    """A whole number from ``low`` to ``high``."""

    low: int
    high: int


@dataclass(frozen=True)
class Text:
    """A word, which is compared with the rig's."""


Range = Real | Whole | Text | type
_FRACTION = Real(0.0, 1.0)

RANGES: Mapping[type, Mapping[str, Range]] = {
    Noise: {
        "K_DN_per_e": Real(1e-4, 1e5),
        "black_DN": Real(-65536.0, 65536.0),
        "saturation_DN": Real(1.0, 2.0**20),
        "sigma_d_e": Real(0.0, 1e6),
        "lambda_read": Real(-10.0, 10.0),
        "sigma_row_DN": Real(0.0, 65536.0),
        "q_DN": Real(1e-3, 65536.0),
        "dark_current_e_per_s": Real(-1e6, 1e8),
        "DSNU1288_e": Real(0.0, 1e6),
        "PRNU1288": Real(0.0, 10.0),
        "nonlinearity": Real(-0.25, 0.25),
    },
    Geometry: {
        "focal_px": Real(1.0, 1e6, (2,)),
        "principal_point_px": Real(-1e5, 1e5, (2,)),
        "distortion": Real(-1e6, 1e6, (5,)),
        "rotation_rad": Real(-7.0, 7.0, (3,)),
        "pupil_mm": Real(-1e6, 1e6, (3,)),
    },
    Wire: {
        "geometry": Geometry,
        "rotation_rad": Real(-7.0, 7.0, (3,)),
        "standoff_per_pitch": Real(1e-3, 1e6),
        "offset_periods": Real(-1e6, 1e6, (2,)),
        "footprint_per_pitch": Real(1e-3, 1e6),
        # Noise may take an opening somewhat beyond its period.
        "row_open": Real(0.0, 2.0),
        "column_open": Real(0.0, 2.0),
        "depth_per_pitch": Real(-100.0, 100.0),
        "harmonics": Real(-float(HIGHEST_ORDER), float(HIGHEST_ORDER), ("harmonics", 2)),
        "frequency": Real(-1e3, 1e3, ("harmonics", 2)),
        "fields": Real(-1e6, 1e6, ("harmonics", 2, 2, "degrees")),
        "amplitudes": Real(-1e6, 1e6, ("strongest", 2, "degrees in y", "degrees in x")),
        "baseline": Real(-1e3, 1e3, ("baseline degrees in y", "baseline degrees in x")),
    },
    Diffraction: {
        "pitch_mm": Real(1e-3, 100.0),
        "openings": Real(0.0, 2.0, (2,)),
        "depth_mm": Real(-100.0, 100.0),
        "depth_ratio": Real(-10.0, 10.0),
        "bar_width": Real(-1.0, 1.0, (2,)),
        "bar_place": Real(-1.0, 1.0, (2,)),
        "corner_radius": Real(-1.0, 1.0),
        "slant": Real(-1.0, 10.0, (2,)),
        "pupil_diameter_mm": Real(1e-3, 1e3),
        "offset_periods": Real(-1e6, 1e6, (2,)),
        "standoff_per_pitch": Real(-1e6, 1e6),
        "visibility": _FRACTION,
        "blur_px": Real(-100.0, 100.0),
        "blur_growth": Real(-100.0, 100.0, (2,)),
        "blur_colour": Real(-10.0, 10.0, (3,)),
        "wavelengths_nm": Real(200.0, 2000.0, ("wavelengths",)),
        "spectrum": Real(-10.0, 10.0, (3, "wavelengths")),
    },
    PsfField: {
        "geometry": Geometry,
        "diffraction": Diffraction,
        "diffraction_fraction": _FRACTION,
        "residual": Real(-1e3, 1e3, ("terms", 3, "rows", "columns")),
        "centre_px": Real(-1e5, 1e5, (2,)),
        "half_px": Real(0.5, 1e5, (2,)),
        "support_px": Real(0.0, 1e5, (2,)),
        "degree": Whole(-1, 8),
        "fine": Whole(4, 16),
    },
    Backscatter: {
        "geometry": Geometry,
        "mask": Real(-1e9, 1e9, (3, "rows", "columns")),
        "mix": Real(0.0, 1.0, (3, 3)),
        "gamma": Real(0.1, 10.0),
        "pitch_mm": Real(1e-3, 100.0),
        "pupil_diameter_mm": Real(1e-3, 1e3),
        "standoff_mm": Real(1e-3, 1e5),
        "emitters_px": Real(-1e4, 1e4, (3, 2)),
        "softness_px": Real(1e-4, 1e3),
        "reflection": Real(0.0, 1e12),
        "reflection_mm": Real(0.0, 1e4),
        "columns": Whole(64, 16384),
        "rows": Whole(64, 16384),
        "cfa": Text(),
        "step": Whole(1, 8192),
        "window": Whole(1, 1024),
    },
}


def check_term(term: Any, name: str, rig: RigDescription) -> None:
    """Refuse a term whose numbers are out of range, or do not fit each other or the rig.

    ``name`` is the section's name, for the message.

    Raises:
        ProfileError: with the field, what was expected and what was found.
    """
    check_ranges(term, name)
    for field, allowed in RANGES[type(term)].items():
        if isinstance(allowed, type):
            check_term(getattr(term, field), f"{name}.{field}", rig)
    _TOGETHER.get(type(term), _nothing)(term, name, rig)


def check_ranges(term: Any, name: str, advice: str = _ADVICE) -> None:
    """Refuse a term with a number out of its own range, whatever the others are; name and errors as ``check_term``.

    ``advice`` ends the message.
    """
    sizes: dict[str, int] = {}
    for field, allowed in RANGES[type(term)].items():
        value, where = getattr(term, field), f"{name}.{field}"
        match allowed:
            case Real():
                _check_real(value, allowed, where, sizes, advice)
            case Whole():
                _require(
                    isinstance(value, int) and not isinstance(value, bool) and allowed.low <= value <= allowed.high,
                    where, f"a whole number from {allowed.low} to {allowed.high}", value, advice,
                )  # fmt: skip
            case Text():
                _require(isinstance(value, str), where, "a word", value, advice)
            case _:
                _require(isinstance(value, allowed), where, f"a {allowed.__name__}", value, advice)
                check_ranges(value, where, advice)


def _check_real(value: Any, allowed: Real, where: str, sizes: dict[str, int], advice: str) -> None:
    number = isinstance(value, int | float | np.ndarray | np.generic) and not isinstance(value, bool)
    array = np.asarray(value if number else "")
    wanted = tuple(sizes.get(size, size) if isinstance(size, str) else size for size in allowed.shape)
    fits = array.ndim == len(wanted) and all(
        isinstance(size, str) or size == found for size, found in zip(wanted, array.shape, strict=True)
    )
    of_shape = f" of shape ({', '.join(map(str, wanted))})" if wanted else ""
    real = number and fits and (isinstance(value, int) or np.issubdtype(array.dtype, np.floating))
    _require(real, where, f"real numbers{of_shape}" if wanted else "a real number", _summary(value), advice)
    sizes.update((size, found) for size, found in zip(wanted, array.shape, strict=True) if isinstance(size, str))
    wrong = array[~((array >= allowed.low) & (array <= allowed.high))]
    found = wrong[0] if wrong.size else None
    _require(not wrong.size, where, f"from {allowed.low:g} to {allowed.high:g}", found, advice)


def _summary(value: Any) -> Any:
    return f"{value.dtype} of shape {value.shape}" if isinstance(value, np.ndarray) else value


def _require(holds: bool, where: str, expected: str, found: object, advice: str = _ADVICE) -> None:
    if not holds:
        raise ProfileError(f"Expected '{where}' to be {expected}, found {str(found)[:60]}. {advice}")


def _nothing(term: Any, name: str, rig: RigDescription) -> None:
    """Check nothing: this term's fields do not bound one another."""


def _check_noise(term: Noise, name: str, rig: RigDescription) -> None:
    black, top = float(np.asarray(term.black_DN)), float(np.asarray(term.saturation_DN))
    _require(top > black, f"{name}.saturation_DN", f"above black_DN, {black:g}", top)


def _check_wire(term: Wire, name: str, rig: RigDescription) -> None:
    orders, half_ranges = np.asarray(term.harmonics), np.asarray(term.frequency)[:, 1]
    _require(bool(np.all(orders == np.round(orders))), f"{name}.harmonics", "whole numbers", "fractions")
    least = float(half_ranges.min(initial=np.inf))
    _require(least > 0, f"{name}.frequency", "half ranges above 0", least)
    strongest, most = len(np.asarray(term.amplitudes)), len(orders)
    _require(strongest <= most, f"{name}.amplitudes", f"of at most the {most} harmonics", strongest)
    for field in ("fields", "amplitudes", "baseline"):
        degrees = np.shape(getattr(term, field))[-2 if field != "fields" else -1 :]
        _require(all(1 <= d <= 64 for d in degrees), f"{name}.{field}", "of 1 to 64 degrees", degrees)


def _check_diffraction(term: Diffraction, name: str, rig: RigDescription) -> None:
    nodes = np.asarray(term.wavelengths_nm, dtype=np.float64)
    _require(2 <= len(nodes) <= 64, f"{name}.wavelengths_nm", "2 to 64 wavelengths", len(nodes))
    steps = np.diff(nodes)
    _require(
        bool(steps[0] >= 0.1 and np.ptp(steps) <= 1e-3 * steps[0]),
        f"{name}.wavelengths_nm", "rising in even steps of at least 0.1 nm", f"steps from {steps.min():g} nm on",
    )  # fmt: skip
    light = np.asarray(term.spectrum, dtype=np.float64).sum(axis=1)
    off = light[np.abs(light - 1.0) > 1e-3]
    _require(not off.size, f"{name}.spectrum", "light that sums to 1 in each colour", off[0] if off.size else None)


def _check_psf(term: PsfField, name: str, rig: RigDescription) -> None:
    terms, _, rows, columns = np.shape(term.residual)
    wanted = polynomial_terms(term.degree)
    _require(
        terms == wanted,
        f"{name}.residual",
        f"of the {wanted} terms that polynomials of degree {term.degree} have",
        terms,
    )
    for found, most in ((rows, rig.camera.rows), (columns, rig.camera.columns)):
        _require(
            found % 2 == 1 and found <= most + 1,
            f"{name}.residual", f"an odd number of pixels high and wide, at most the sensor's {most}", found,
        )  # fmt: skip


def _check_backscatter(term: Backscatter, name: str, rig: RigDescription) -> None:
    camera = rig.camera
    for field, own in (("columns", camera.columns), ("rows", camera.rows), ("cfa", camera.cfa)):
        _require(getattr(term, field) == own, f"{name}.{field}", f"the rig's, {own}", getattr(term, field))
    grid = (camera.rows // term.step, camera.columns // term.step)
    _require(min(grid) >= 2, f"{name}.step", "at most half the sensor", term.step)
    found = np.shape(term.mask)[1:]
    _require(found == grid, f"{name}.mask", f"{grid[1]} x {grid[0]} values, one every {term.step} px", found[::-1])
    most = int((_MOST_SHARES / (grid[0] * grid[1])) ** 0.5)
    _require(term.window <= max(most, 1), f"{name}.window", f"at most {most} for a grid this fine", term.window)
    sums = np.asarray(term.mix, dtype=np.float64).sum(axis=1)
    off = sums[np.abs(sums - 1.0) > 1e-3]
    _require(not off.size, f"{name}.mix", "rows that sum to 1", off[0] if off.size else None)


_TOGETHER: Mapping[type, Callable[[Any, str, RigDescription], None]] = {
    Noise: _check_noise,
    Wire: _check_wire,
    Diffraction: _check_diffraction,
    PsfField: _check_psf,
    Backscatter: _check_backscatter,
}
