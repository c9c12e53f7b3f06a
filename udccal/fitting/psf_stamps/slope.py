"""A slope of the background that all stamps have in common, as of stray light over the sensor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from udccal.fitting.psf_stamps.data import Stamps, at_edge

# Sigmas from which a slope is no chance, and stars that must tell it.
_SURE, _FEWEST = 5.0, 8


def without_slope(stamps: Stamps) -> tuple[Stamps, tuple[str, ...]]:
    """Stamps less the slope that their borders have in common, where it is significant, and a note of it."""
    slope = np.array([_common(stamps, seen) for seen in stamps.by_plane])
    if not slope.any():
        return stamps, ()
    tilt = np.take_along_axis(slope @ stamps.offset_px.T, stamps.plane, axis=0)
    level = stamps.value_e - np.where(stamps.clipped, 0.0, tilt)
    values = np.where(stamps.known, level, np.nan).reshape(stamps.values_e.shape)
    told = ", ".join(f"({x:+.2g}, {y:+.2g})" for x, y in slope)
    advice = "It was taken off, without its uncertainty; subtract the background beforehand."
    return replace(stamps, values_e=values), (f"The background of all stamps slopes by {told} e-/px (x, y). {advice}",)


def _common(stamps: Stamps, seen: Bool[np.ndarray, "stars samples"]) -> Float[np.ndarray, "2"]:
    """The slope along x and y of one colour's borders that does not grow with a star's light; 0 where not sure.

    A psf's own wings are as uneven as they like, in proportion to the light.
    """
    border = np.ma.masked_array(stamps.value_e, ~(seen & at_edge(stamps) & ~stamps.clipped))
    # Medians of opposite sides, so that hits do not count.
    slopes = np.full((len(border), 2), np.nan)
    for axis, off in enumerate(stamps.offset_px.T / (0.85 * np.abs(stamps.offset_px).max(axis=0))[:, None]):
        high, low = (np.ma.median(border[:, side], axis=1).filled(np.nan) for side in (off > 1, off < -1))
        slopes[:, axis] = (high - low) / (2 * stamps.offset_px[off > 1, axis].mean())
    light = ((stamps.value_e - np.ma.median(border, axis=1).filled(np.nan)[:, None]) * seen).sum(axis=1)
    stars = np.isfinite(slopes).all(axis=1)
    if stars.sum() < _FEWEST:
        return np.zeros(2)
    slopes, light = slopes[stars], light[stars]
    # Flat stamps have no light over their borders; any unit serves.
    design = np.stack([np.ones(len(light)), light / (np.median(light) or 1.0)], axis=1)
    inverse = np.linalg.pinv(design.T @ design)
    fitted = inverse @ design.T @ slopes
    sigma = np.sqrt(inverse[0, 0] * ((slopes - design @ fitted) ** 2).sum(axis=0) / (len(light) - 2))
    return np.where(np.abs(fitted[0]) > _SURE * sigma, fitted[0], 0.0)
