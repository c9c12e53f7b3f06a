"""Deblurring of colour pictures by kernels that vary over the field, with nothing else known.

The same filter as for mosaics, for pictures that have all three colours at every pixel; then the same shrinkage of
noise. The picture itself tells how noisy it is. The variance is a straight line over its light,

    variance = read + light / gain,

fitted to the finest diagonal detail of the tiles, where a blurred picture has next to nothing but noise.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float, Float32
from scipy.optimize import nnls

from udccal.arguments import check_count
from udccal.errors import RestorationError
from udccal.restoration.blur import blurred
from udccal.restoration.checks import real_array
from udccal.restoration.colour_tables import THREE_COLOURS, colour_tables
from udccal.restoration.kernel_grid import KernelGrid
from udccal.restoration.mosaic_filter import filtered_and_joined
from udccal.restoration.network import refined, sharper
from udccal.restoration.plan import PlanOptions
from udccal.restoration.shrink import measured_noise, shrunk
from udccal.restoration.tiles import GENERAL, TileLayout, layout_for
from udccal.tiers import Tier, tier_named

# Second differences: the finest detail along one axis.
_SECOND = (1.0, -2.0, 1.0)
# Median of |x| of a normal distribution with sigma 1.
_MEDIAN = 0.6745
_REWEIGHTINGS = 3
# Detail below this, of the largest value, is rounding; where all of it within as many px is, the picture is flat.
_FLAT, _NEAR = 2e-6, np.ones((5, 5), dtype=np.uint8)
# Least part of a tile from which noise is taken.
_LEAST_SEEN = 0.05
# Rounding to single precision, of the largest value. A picture that is flat in most places shows no noise at all.
_LEAST_VARIANCE = float(np.finfo(np.float32).eps) ** 2
# What kernels leave unexplained, of the light that they move: their own errors, and light from beyond the picture's
# border. Taken for the scene's, it is amplified: clean pictures came out up to 20 dB worse than they went in.
_UNEXPLAINED = 0.01
# The result is in single precision, and overshoots.
_MOST = 1e36


def deblur(
    picture: Float[np.ndarray, "..."],
    kernels: Float[np.ndarray, "..."],
    x_px: Float[np.ndarray, "..."],
    y_px: Float[np.ndarray, "..."],
    tile_px: int = 192,
    workers: int = 2,
    tier: Tier | str = Tier.balanced,
) -> Float32[np.ndarray, "rows columns 3"]:
    """Deblur a picture.

    Args:
        picture: (rows, columns, 3), linear light of three colours in any unit.
        kernels: (grid rows, grid columns, 3, kernel rows, kernel columns), by place of the source and colour. Their
            middle sample is the source's place. Each sums to 1.
        x_px: columns of the picture at which the kernels lie, ascending. y_px: rows.
        tile_px: rows and columns of a tile at most; a tile has one kernel and one prior. At least 96.
        workers: threads.
        tier: how much is done; not ``preview``, which does not deblur.

    Returns:
        the picture as it was before the blur, in its unit. Where there is noise alone, values scatter about 0.

    Raises:
        RestorationError: when a number is not finite or beyond single precision, the kernels do not sum to 1 or have
            no middle sample, shapes do not agree, a number of tiles or threads cannot be, or the tier does not deblur.
    """
    tier = tier_named(tier)
    if tier is Tier.preview:
        raise RestorationError("Expected a tier that deblurs, found preview. Give fast, balanced or accurate.")
    check_count(tile_px, "tile_px", 1, 16384, RestorationError)
    check_count(workers, "workers", 1, 256, RestorationError)
    given_arrays = {"picture": picture, "kernels": kernels, "x_px": x_px, "y_px": y_px}
    picture, *places = (real_array(each, what) for what, each in given_arrays.items())
    grid = _checked(picture, *places)
    # In units of its largest value: squares stay in single precision's range.
    unit = float(np.max(np.abs(picture), initial=0.0)) or 1.0
    light = np.ascontiguousarray(picture / unit, dtype=np.float32)
    rows, columns = light.shape[:2]
    layout = layout_for(rows, columns, (1, 1), (tile_px, tile_px), (0, rows), GENERAL, shared=0.0)
    tiles = _cut(light, layout)
    read, slope = _noise_line(tiles, _finest(rows, columns))
    unexplained = _UNEXPLAINED * max(1.0 - float(grid.kernels.max(axis=(3, 4)).min()), 0.0)
    least = np.maximum(unexplained**2 * np.square(tiles).mean(axis=(2, 3)), _LEAST_VARIANCE)
    noise = np.sqrt(np.maximum(read + slope * tiles.mean(axis=(2, 3)), least)).astype(np.float32)
    tables = colour_tables(grid, layout, workers)
    given = noise, tables, layout, THREE_COLOURS
    chosen, strengths = filtered_and_joined(tiles, *given)
    if tier is Tier.fast:
        return chosen * np.float32(unit)
    bands = measured_noise(tables, layout, THREE_COLOURS, workers, np.unique(strengths)).of_tiles(strengths)
    near = np.maximum(cv2.blur(light.mean(axis=2), (16, 16)), 0)
    local = np.maximum(read + slope * near, np.square(unexplained * near)).astype(np.float32)
    balanced = shrunk(chosen, noise, local, bands, layout, workers)
    if tier is Tier.balanced:
        return balanced * np.float32(unit)
    sharp, _ = filtered_and_joined(tiles, *given, sharper(strengths))
    best = refined(balanced, chosen, sharp, noise, local, bands, layout, PlanOptions.network_views)
    # The samples have the last word: the filter of what they have more or less than the picture gives.
    rest = _cut(light - blurred(best, grid, layout), layout)
    return (best + filtered_and_joined(rest, *given)[0]) * np.float32(unit)


def _cut(
    light: Float32[np.ndarray, "rows columns 3"], layout: TileLayout
) -> Float32[np.ndarray, "tiles 3 down across"]:
    return np.stack([layout.cut(plane) for plane in cv2.split(light)], axis=1)


def _finest(rows: int, columns: int) -> Float32[np.ndarray, "down across"]:
    """Return the filter for the finest detail of a picture: diagonal, or along a single row or column."""
    down, across = (_SECOND if size > 1 else (1.0,) for size in (rows, columns))
    return np.outer(down, across).astype(np.float32)


def _noise_line(
    tiles: Float32[np.ndarray, "tiles 3 rows columns"], finest: Float32[np.ndarray, "down across"]
) -> tuple[float, float]:
    """Return the variance of the noise without light, and how it grows with light; ``finest`` is a filter's kernel."""
    gain = float(np.sum(finest**2))
    variance, light, seen = np.array([_noise_of(plane, finest) for plane in tiles.reshape(-1, *tiles.shape[2:])]).T
    # Tiles that are mostly clipped or blank tell only where no others do.
    used = seen >= (0.5 if seen.max() >= 0.5 else _LEAST_SEEN)
    if not used.any():
        return 0.0, 0.0
    variance, light = variance[used] / gain, light[used]
    design = np.stack([np.ones_like(light), light], axis=1)
    # Detail adds to noise, so that the lower ones of what was found are the noise.
    weight = np.ones_like(light)
    read, slope = 0.0, 0.0
    for _ in range(_REWEIGHTINGS):
        (read, slope), _ = nnls(design * weight[:, None], variance * weight)
        expected = np.maximum(read + slope * light, np.finfo(np.float64).tiny)
        weight = np.where(variance > 1.5 * expected, 0.1, 1.0) / expected
        weight /= weight.max()
    return float(read), float(slope)


def _noise_of(
    plane: Float32[np.ndarray, "rows columns"], finest: Float32[np.ndarray, "down across"]
) -> tuple[float, float, float]:
    """Return the square of the detail's sigma and the mean light of a plane, and the part of it that they are from.

    Clipped and blank areas have no noise. They would make that of all others seem smaller.
    """
    detail = np.abs(cv2.filter2D(plane, cv2.CV_32F, finest))
    seen = cv2.dilate(detail, _NEAR) > _FLAT
    if not seen.any():
        return 0.0, 0.0, 0.0
    sigma = float(np.median(detail[seen])) / _MEDIAN
    return sigma**2, max(float(plane[seen].mean()), 0.0), float(seen.mean())


def _checked(picture: np.ndarray, kernels: np.ndarray, x_px: np.ndarray, y_px: np.ndarray) -> KernelGrid:
    if picture.ndim != 3 or picture.shape[2] != 3 or kernels.ndim != 5 or kernels.shape[2] != 3 or not picture.size:
        raise RestorationError(
            "Expected a picture of rows x columns x 3 and kernels of grid rows x grid columns x 3 x rows x columns, "
            f"found {picture.shape} and {kernels.shape}. Give three colours of both."
        )
    if kernels.shape[3] % 2 == 0 or kernels.shape[4] % 2 == 0:
        raise RestorationError(
            "Expected kernels of odd rows and columns, whose middle sample is the source's place, found "
            f"{kernels.shape[3]} x {kernels.shape[4]}. Pad them by a row or column of zeros."
        )
    agree = kernels.shape[:2] == y_px.shape + x_px.shape and 0 not in kernels.shape
    if not agree or np.any(np.diff(x_px) <= 0) or np.any(np.diff(y_px) <= 0):
        raise RestorationError(
            f"Expected ascending places of {kernels.shape[1]} columns and {kernels.shape[0]} rows of kernels, found "
            f"x_px of shape {x_px.shape} and y_px of {y_px.shape}. Give the picture's px at which each kernel lies."
        )
    if not all(np.all(np.abs(each) < _MOST) for each in (picture, kernels, x_px, y_px)):
        raise RestorationError(
            f"Expected numbers between -{_MOST:g} and {_MOST:g}, found others, NaN or infinity. Replace them first."
        )
    sums = kernels.sum(axis=(3, 4))
    if not np.allclose(sums, 1.0, atol=0.02):
        raise RestorationError(
            f"Expected kernels that sum to 1, found sums from {sums.min():g} to {sums.max():g}. Divide each by its sum."
        )
    return KernelGrid(np.asarray(x_px, float), np.asarray(y_px, float), kernels)
