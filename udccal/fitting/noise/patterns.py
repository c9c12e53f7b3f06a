"""Variances between pixels: DSNU of dark averages, with the other dark quantities, and PRNU behind a panel.

The response of pixels is white; light is not. Light that passed a panel is modulated. The modulation's harmonics and
their products fall slowly below the floor of the pixels' own response. One coefficient of the spectrum, or a block of
them, does not show light below the floor, but the power of many blocks does: rectangles of all sizes are tested. Light
that is too weak to show continues to higher frequencies, so that the spectrum is cut further out.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import final

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy.fft import dctn
from scipy.special import ndtri

from udccal.fitting.engine.orders import Quantity
from udccal.fitting.engine.robust import MAD_TO_SIGMA
from udccal.fitting.noise.codes import DarkFit
from udccal.fitting.noise.frame_moments import product_sum
from udccal.fitting.noise.line_noise import LineNoise

Picture = Float[np.ndarray, "rows columns"] | Float32[np.ndarray, "rows columns"]
Mask = Bool[np.ndarray, "rows columns"]
Grid = Float[np.ndarray, "down across"]
# Of black and dark current.
Cov = Float[np.ndarray, "2 2"]


@final
@dataclass(frozen=True)
class Pattern:
    """A variance between pixels (may be negative by chance), its standard deviation, samples, and outliers left out.

    It is that of the pixels at hand (EMVA 1288), not of all sensors of the kind: the draw of these is no part of sigma.
    ``mean`` is that of the samples left in; ``places`` are (row, column) of the first outliers. ``structure2`` is a
    variance between pixels that is not white, so that it was taken for the light's; 0 where it cannot be seen.
    """

    variance: float
    sigma: float
    samples: int
    outliers: int
    places: tuple[tuple[int, int], ...]
    mean: float = 0.0
    structure2: float = 0.0


def dsnu(
    dark_DN: Picture,
    temporal: Quantity,
    rows: LineNoise,
    columns: LineNoise,
    frames: int,
    defect_sigma: float,
    q_DN: int,
    tails: bool,
) -> Pattern:
    """Variance of the pixels' offsets in an averaged dark frame (EMVA 1288, clause 8.2), with row and column patterns.

    The average of so many ``frames`` has the variance ``temporal`` [DN^2], of which ``columns`` is a part, without the
    noise of ``rows``; both are one frame's. ``q_DN`` is the converter's step. Where the noise has heavy ``tails``, what
    lies up to twice as far off as a defect may be one, or noise that the average of few frames still has.
    """
    about = dark_DN.astype(np.float64)
    sample = about[:: max(1, len(about) // 256)]
    middle = float(np.median(sample))
    # Averages of few frames are coarse: a spread below their step does not measure the usual scatter. Where half of the
    # pixels have one code in every frame, those that have the next one in some are no defects.
    usual = float(np.median(np.abs(sample - middle)))
    reach = defect_sigma * MAD_TO_SIGMA * usual if usual > 1e-3 * q_DN else q_DN
    bad = np.abs(about - middle) > max(reach, float(sample.std()), 1e-12)
    mean = float(about[~bad].mean()) if not bad.all() else 0.0
    about -= mean
    (height, width), samples = about.shape, int(about.size - bad.sum())
    doubtful = 0.5 * tails * float(np.sum(about[bad & (np.abs(about) <= 2 * reach)] ** 2)) / max(samples, 1)
    about[bad] = 0.0
    total = float(np.vdot(about, about)) / max(samples - 1, 1)
    by_row, by_column = float(np.var(about.mean(axis=1))), float(np.var(about.mean(axis=0)))
    pixel, row, column = max(total - by_row - by_column, 0.0), rows.DN2.value / frames, columns.DN2.value / frames
    parts, counts = np.array([pixel, by_row, by_column]), [samples, rows.independent, columns.independent]
    own = np.maximum(parts - [temporal.value - column, pixel / width + row, pixel / height + column], 0.0)
    # Each part is chi-squared with its own number of values; this sensor's own pattern is what is asked for. Few bands
    # may by chance be weak in the average.
    drawn = float(np.sum(2 * np.maximum(parts**2 - own**2, np.square([0.0, row, column])) / counts))
    drawn += temporal.variance + rows.DN2.variance * rows.DN2.there / frames**2
    variance, sigma = total - temporal.value - row + doubtful, float(np.sqrt(drawn + doubtful**2))
    return Pattern(variance, sigma, samples, int(bad.sum()), _first_places(bad), mean)


@final
@dataclass(frozen=True)
class DarkTerms:
    """Dark quantities; ``levels_cov`` is that of (black, dark current); ``white``: no pixel's mean shows rounding.

    ``foreign``: no distribution of the family describes the read noise; its variance is that of the codes. ``skewed``:
    none describes the mean code; black and dark current are those of the mean of all pixels. Black differs from
    exposure to exposure by ``unsteady_DN``, where that is more than noise. Where that is a curve over exposures, dark
    current differs by ``drift_DN_per_s`` at the shortest. ``own_shot_DN2_per_s`` is by how much the variance of dark
    frames grows with exposure, where that is not the shot noise of the dark current that their mean tells.
    """

    K_DN_per_e: float
    curvature: float
    black_DN: float
    dark_DN_per_s: Quantity
    levels_cov: Cov
    unsteady_DN: float
    drift_DN_per_s: float
    read_DN2: Quantity
    shape: Quantity
    rows: LineNoise
    columns: LineNoise
    dsnu_DN2: Quantity
    white: bool
    foreign: bool
    skewed: bool
    fit: DarkFit
    offsets: Pattern
    own_shot_DN2_per_s: Quantity | None = None

    def shot_DN2(self, K_DN_per_e: float, exposure_s: float) -> float:
        """Variance of dark current's shot noise at this gain."""
        own = self.own_shot_DN2_per_s
        return (own.value if own else K_DN_per_e * self.dark_DN_per_s.value) * exposure_s

    @property
    def row_DN2(self) -> Quantity:
        """Variance of the noise that rows share."""
        return self.rows.DN2


def _first_places(bad: Mask) -> tuple[tuple[int, int], ...]:
    """Row and column of the first eight marked pixels."""
    rows, columns = np.unravel_index(np.flatnonzero(bad)[:8], bad.shape)
    return tuple(zip(rows.tolist(), columns.tolist(), strict=True))


def rough_median(picture: Picture) -> float:
    """Median over about 128 rows, an odd number apart, so that both kinds of a mosaic's rows count."""
    return float(np.median(picture[:: int(picture.shape[0] // 128) | 1]))


@final
@dataclass(frozen=True)
class _Site:
    """One colour: light and the inverse of its shading, both 0 where undefined; defects, and the spectrum's power."""

    light: Float32[np.ndarray, "rows columns"]
    inverse_DN: Float32[np.ndarray, "rows columns"]
    defects: Mask
    power: Float32[np.ndarray, "rows columns"]


def prnu(signal_DN: Picture, temporal_DN2: float, shot_DN: float, period: int, defect_sigma: float) -> Pattern:
    """Variance of the photo response, relative (EMVA 1288, clause 8.3).

    The picture of each colour is divided by its shading. The floor of its spectrum (cosine transform) is measured where
    ``white_coefficients`` finds no light. Modulated light modulates the pixels' patterns as well: the floor is theirs
    times the mean square of the light. ``signal_DN`` is the average of flats minus that of darks; its temporal variance
    is ``temporal_DN2`` at no light, and rises with the signal by ``shot_DN``.
    """
    phases = [np.s_[row::period, column::period] for row, column in product(range(period), repeat=2)]
    # Shading varies over more than 63 samples of one colour.
    window = min(63, (min(signal_DN.shape) // period // 4) * 2 + 1)
    sites = [_site(signal_DN[phase], window, defect_sigma) for phase in phases]
    # The window has removed its part of the lowest frequencies. Sites may differ by a line: the least is common to all.
    rows, columns = (min(site.power.shape[axis] for site in sites) for axis in (0, 1))
    taken = (3 * rows // window + 1, 3 * columns // window + 1)
    white = white_coefficients([site.power[:rows, :columns] for site in sites], taken)
    variances, sigmas, structures, seen = np.array([_response(of, white, temporal_DN2, shot_DN) for of in sites]).T
    weights = 1 / np.maximum(sigmas, 1e-30) ** 2
    variance, samples = float(np.average(variances, weights=weights)), len(sites) * int(np.count_nonzero(white))
    defects = np.zeros(signal_DN.shape, bool)
    for phase, site in zip(phases, sites, strict=True):
        defects[phase] = site.defects
    outliers = signal_DN.size - sum(int(np.count_nonzero(site.inverse_DN)) for site in sites)
    # What is not white but too weak to be seen may be the pixels' own.
    sigma = float(np.hypot(weights.sum() ** -0.5, max(float(np.mean(structures * (1 - seen))), 0.0)))
    structure2 = float(np.mean(structures * seen))
    return Pattern(variance, sigma, samples, outliers, _first_places(defects), structure2=structure2)


def _site(signal_DN: Picture, window: int, reach: float) -> _Site:
    """One colour with its defects: lit pixels more than ``reach`` robust sigma from the middle of their neighbours.

    A defect is off along the row and along the column: pixels at the crests of deep waves are off in one direction.
    """
    site = np.ascontiguousarray(signal_DN, dtype=np.float32)
    level = cv2.blur(site, (window, window), borderType=cv2.BORDER_REFLECT_101)
    unlit = level <= 0
    level[unlit] = 1.0
    relative = site / level - np.float32(1)
    second = np.array([[-0.5, 1.0, -0.5]], np.float32)
    off = [np.abs(cv2.filter2D(relative, -1, kernel)) for kernel in (second, second.T)]
    usual = MAD_TO_SIGMA * min(rough_median(one) for one in off)
    bad = (np.minimum(*off) > np.float32(reach * max(usual, 1e-12))) | unlit
    relative[bad] = cv2.medianBlur(relative, 5)[bad]
    power = dctn(relative, norm="ortho", workers=2)
    return _Site(np.where(bad, 0, 1 + relative), np.where(bad, 0, 1 / level), bad & ~unlit, np.square(power, out=power))


def _response(site: _Site, white: Mask, temporal_DN2: float, shot_DN: float) -> tuple[float, float, float, bool]:
    """Variance of the response and its standard deviation, the variance of what is not white, and whether it shows."""
    light, inverse = site.light, site.inverse_DN
    kept, good = (max(int(np.count_nonzero(mask)), 1) for mask in (white, inverse))
    power = site.power[: white.shape[0], : white.shape[1]]
    floor = product_sum(power, white.astype(np.float32)) / kept * inverse.size / good
    noise = temporal_DN2 * product_sum(inverse, inverse) / good + shot_DN * product_sum(light, inverse) / good
    mean_square = product_sum(light, light) / good
    square = max(mean_square - floor, 0.1)
    structure2 = mean_square - (float(light.sum(dtype=np.float64)) / good) ** 2 - floor
    seen = structure2 > 3 * floor * float(np.sqrt(2.0 / good + 2.0 / kept))
    variance = (floor - noise) / square
    # Pixels of different noise count as fewer pixels of equal noise: one row in eight gives the ratio.
    light, inverse = light[::8], inverse[::8]
    own = max(variance, 0.0) * light**2 + inverse * (temporal_DN2 * inverse + shot_DN * light)
    unlike = float(np.mean(own**2)) / max(float(np.mean(own)) ** 2, 1e-300)
    # The pattern of all pixels is what is asked for; the coefficients that are left out have a part of it.
    sigma2 = 2.0 * max(unlike, 1.0) / kept * (floor / square) ** 2 - 2.0 * max(variance, 0.0) ** 2 / good
    return variance, float(np.sqrt(max(sigma2, 0.0))), structure2, seen


def white_coefficients(powers: list[Float32[np.ndarray, "rows columns"]], taken: tuple[int, int]) -> Mask:
    """Coefficients of cosine transforms that hold white noise alone; all transforms are of the same light.

    The first row and column hold differences between columns and between rows: they are never among them, nor are the
    ``taken`` lowest rows and columns, which the correction of shading has changed.
    """
    rows, columns = powers[0].shape
    keep = np.ones((rows, columns), bool)
    keep[0] = keep[:, 0] = keep[: taken[0], : taken[1]] = False
    block = min(16, rows // 4, columns // 4)
    if block < 2:
        return keep
    count = _by_block(keep, block)
    totals = [_by_block(power * keep, block) for power in powers]
    pooled = sum(total / max(_floor(count, total), 1e-300) for total in totals)
    seen = _light(count * len(powers), np.asarray(pooled))
    wide = np.zeros_like(seen)
    for row, column in np.argwhere(seen):
        # Light too weak to be seen is expected up to twice the frequencies at which it was seen.
        wide[: 2 * (row + 1), : 2 * (column + 1)] = True
    # Where that leaves less than a tenth, all coefficients without visible light are used.
    left_out = wide if count[~wide].sum() >= 0.1 * keep.size else seen
    white, blocks = np.zeros_like(keep), np.kron(~left_out, np.ones((block, block), bool))
    white[: blocks.shape[0], : blocks.shape[1]] = blocks
    return white & keep


def _by_block(values: np.ndarray, block: int) -> Grid:
    """Sums over blocks; coefficients that fill none are left out."""
    high, wide = (n // block * block for n in values.shape)
    # Rows first: sums along contiguous memory are the slow part.
    by_row = np.add.reduce(values[:high, :wide].reshape(high, wide // block, block), axis=2, dtype=np.float32)
    return by_row.reshape(high // block, block, wide // block).sum(axis=1, dtype=np.float64)


def _floor(count: Grid, total: Grid) -> float:
    """Power of the floor from the lowest quartile of the blocks, corrected for the bias of a quartile."""
    full = count >= count.max()
    low = float(np.quantile(total[full] / count[full], 0.25))
    return low / _mean_square(count.max(keepdims=True), float(ndtri(0.25))).item()


def _mean_square(count: Float[np.ndarray, "*n"], z: float) -> Float[np.ndarray, "*n"]:
    """The mean of ``count`` squared normals at ``z`` sigma of its distribution (Wilson, Hilferty, PNAS 17, 1931)."""
    spread = 2 / (9 * np.maximum(count, 1))
    return np.asarray((1 - spread + z * np.sqrt(spread)) ** 3)


def _light(count: Grid, total: Grid) -> Mask:
    """Blocks with a ``total`` power, of ``count`` coefficients, 5 sigma above the floor, alone or in a rectangle."""
    light, floor = np.zeros(count.shape, bool), _floor(count, total)
    # Small rectangles first: light in few blocks must not make large ones of it.
    sides = sorted(product((1, 4, 16), repeat=2), key=lambda side: side[0] * side[1])
    sides = [side for side in sides if side[0] <= len(count) and side[1] <= count.shape[1]]
    for _ in range(8):
        before = light.copy()
        for down, across in sides:
            # Rectangles that begin at each block; those beyond the end are cut there.
            number, power = (
                cv2.boxFilter(np.where(light, 0.0, part), -1, (across, down), anchor=(0, 0), normalize=False,
                              borderType=cv2.BORDER_CONSTANT) for part in (count, total)
            )  # fmt: skip
            number = np.maximum(number, 0.0)
            high = power / np.maximum(number, 1) > max(floor, 1e-300) * _mean_square(number, 5.0)
            # Rectangles half a side apart are tested.
            marks, apart = np.zeros(high.shape, np.uint8), np.s_[:: max(down // 2, 1), :: max(across // 2, 1)]
            marks[apart] = high[apart]
            inside = cv2.dilate(marks, np.ones((down, across), np.uint8), anchor=(across - 1, down - 1)) > 0
            light |= inside & (count > 0)
        floor = float(total[~light].sum()) / max(float(count[~light].sum()), 1.0)
        if np.array_equal(before, light):
            break
    return light
