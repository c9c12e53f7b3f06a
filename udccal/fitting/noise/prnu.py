"""PRNU: how the response differs from pixel to pixel, behind shading and a panel's modulation (EMVA 1288, 8.3).

The response of pixels is white; light is not. Light that passed a panel is modulated, and the modulation's harmonics
and their products sink slowly below the floor that the pixels' own response makes. What sinks below the floor is not
seen in one coefficient of the spectrum, nor in a block of them, but the power of many blocks together still shows it:
rectangles of all sizes are tested. Beyond what was seen the light goes on, unseen; so the spectrum is cut as far out
again.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy.fft import dctn
from scipy.special import ndtri

from udccal.fitting.engine.robust import MAD_TO_SIGMA
from udccal.fitting.noise.dark import DarkTerms, Unevenness, first_places
from udccal.fitting.noise.data import NoiseMoments
from udccal.fitting.noise.flats import Curve
from udccal.fitting.noise.rules import NoiseRules
from udccal.fitting.noise.transfer import linear_signal

# Side of the window whose median stands for a defect; of a picture's rows, one in so many tells how unlike its pixels'
# noise is.
_AROUND, _SPARSE = 5, 8
# Coefficients per side of a block, and sides of the tested rectangles in blocks, the small ones first.
_BLOCK = 16
_SIDES = sorted(((down, across) for down in (1, 4, 16) for across in (1, 4, 16)), key=lambda side: side[0] * side[1])
_ROUNDS = 8
# Where the light has less than three quarters of the blocks, this quantile of them is of the floor.
_QUANTILE = 0.25

Picture = Float[np.ndarray, "rows columns"] | Float32[np.ndarray, "rows columns"]
Grid = Float[np.ndarray, "down across"]
Mask = Bool[np.ndarray, "down across"]


@final
@dataclass(frozen=True)
class _Site:
    """One colour: signal over shading less one, that shading, what is no measure of either, and the spectrum."""

    relative: Float32[np.ndarray, "rows columns"]
    level_DN: Float32[np.ndarray, "rows columns"]
    bad: Bool[np.ndarray, "rows columns"]
    unlit: Bool[np.ndarray, "rows columns"]
    power: Float32[np.ndarray, "rows columns"]


def photo_response(data: NoiseMoments, dark: DarkTerms, curve: Curve, rules: NoiseRules) -> Unevenness:
    """PRNU from the stacks; the temporal variance that averaging left comes from the photon transfer curve."""
    K, V0, c = (float(v) for v in curve.fit.values[:3])
    bright, stack, rate = data.flat_stack, data.dark_stack, dark.dark_DN_per_s.value
    quiet = max(V0, 0.0) + data.q_DN**2 / 12.0
    at_no_light = (quiet + K * rate * bright.exposure_s) / bright.frames
    if dark.white:
        signal = bright.mean_DN.astype(np.float32) - stack.mean_DN.astype(np.float32)
        at_no_light += (quiet + K * rate * stack.exposure_s) / stack.frames
    else:
        # Dark codes that are cut off or coarse do not show the offsets: their variance is taken off instead.
        signal = bright.mean_DN.astype(np.float32) - np.float32(dark.black_DN + rate * bright.exposure_s)
        at_no_light += dark.dsnu_DN2.value
    level = max(rough_median(signal), 1e-6)
    z = float(linear_signal(np.array(level), c, K))
    steep = 1 - 2 * c * z
    found = prnu(signal, at_no_light, K * z * steep**2 / level / bright.frames, data.period, rules)
    # Where the response bends, a relative change of light is a smaller relative change of signal.
    scale = (level / (z * steep)) ** 2
    offsets = 0.0 if dark.white else float(np.sqrt(dark.dsnu_DN2.variance)) / level**2
    return replace(found, variance=found.variance * scale, sigma=float(np.hypot(found.sigma, offsets)) * scale)


def prnu(signal_DN: Picture, temporal_DN2: float, shot_DN: float, period: int, rules: NoiseRules) -> Unevenness:
    """Variance of the photo response, relative.

    Per colour the picture is divided by its shading, and the floor of its spectrum (cosine transform) is taken where
    ``white_coefficients`` finds no light. Where the light is modulated the pixels' patterns are so as well: the floor
    is theirs times the mean square of the light.

    Args:
        signal_DN: average of flats minus average of darks.
        temporal_DN2: temporal variance of one sample of it at no light.
        shot_DN: what a DN of signal adds to that variance, in DN^2 per DN.
        period: sites of the colour mosaic repeat after so many samples (1: monochrome).
        rules: size of the shading's window, and what is light.
    """
    phases = [(row, column) for row in range(period) for column in range(period)]
    window = min(rules.shading, (min(signal_DN.shape) // period // 4) * 2 + 1)
    sites = [_site(signal_DN[row::period, column::period], window, rules) for row, column in phases]
    # The window has taken its part of the lowest frequencies. Sites may differ by a line: the least is common to all.
    rows, columns = (min(site.power.shape[axis] for site in sites) for axis in (0, 1))
    taken = (3 * rows // window + 1, 3 * columns // window + 1)
    white = white_coefficients([site.power[:rows, :columns] for site in sites], taken, rules)
    parts = [_of_site(site, white, temporal_DN2, shot_DN) for site in sites]
    weights = np.array([1 / max(sigma, 1e-30) ** 2 for _, sigma in parts])
    variance = float(np.average([value for value, _ in parts], weights=weights))
    samples = len(sites) * int(np.count_nonzero(white))
    places = [
        (period * row + at[0], period * column + at[1])
        for site, at in zip(sites, phases, strict=True)
        for row, column in first_places(site.bad & ~site.unlit)
    ]
    return Unevenness(
        variance=variance,
        sigma=float(1 / np.sqrt(weights.sum())),
        samples=samples,
        outliers=sum(int(site.bad.sum()) for site in sites),
        mean=0.0,
        mean_variance=max(variance, 0.0) / max(samples, 1),
        places=tuple(places[:8]),
    )


def _site(signal_DN: np.ndarray, window: int, rules: NoiseRules) -> _Site:
    site = np.ascontiguousarray(signal_DN, dtype=np.float32)
    level = cv2.blur(site, (window, window), borderType=cv2.BORDER_REFLECT_101)
    unlit = level <= 0
    level[unlit] = 1.0
    relative = site / level
    relative -= np.float32(1)
    bad = _defects(relative, rules.defect_sigma) | unlit
    relative[bad] = cv2.medianBlur(relative, _AROUND)[bad]
    power = dctn(relative, norm="ortho", workers=2)
    return _Site(relative, level, bad, unlit, np.square(power, out=power))


def _defects(relative: Float32[np.ndarray, "rows columns"], reach: float) -> Bool[np.ndarray, "rows columns"]:
    """Pixels ``reach`` robust sigma from the middle of their neighbours both along the row and along the column.

    At the crests of deep waves of light pixels are off across the wave: that is no defect.
    """
    second = np.array([[-0.5, 1.0, -0.5]], np.float32)
    off = [np.abs(cv2.filter2D(relative, -1, kernel)) for kernel in (second, second.T)]
    usual = MAD_TO_SIGMA * min(rough_median(one) for one in off)
    return np.minimum(*off) > np.float32(reach * max(usual, 1e-12))


def _of_site(
    site: _Site, white: Bool[np.ndarray, "rows columns"], temporal_DN2: float, shot_DN: float
) -> tuple[float, float]:
    """Variance of the response and its standard deviation."""
    kept = max(int(np.count_nonzero(white)), 1)
    good = max(int(site.bad.size - np.count_nonzero(site.bad)), 1)
    power = site.power[: white.shape[0], : white.shape[1]]
    floor = _mean_product(power, white.astype(np.float32), kept) * site.bad.size / good
    inverse_level, light = 1 / site.level_DN, 1 + site.relative
    inverse_level[site.bad] = 0.0
    light[site.bad] = 0.0
    noise = temporal_DN2 * _mean_product(inverse_level, inverse_level, good)
    noise += shot_DN * _mean_product(light, inverse_level, good)
    square = max(_mean_product(light, light, good) - floor, 0.1)
    variance = (floor - noise) / square
    rows = np.s_[::_SPARSE]
    own = max(variance, 0.0) * light[rows] ** 2 + inverse_level[rows] * (
        temporal_DN2 * inverse_level[rows] + shot_DN * light[rows]
    )
    # Pixels of unlike noise are worth fewer of like noise.
    unlike = float(np.mean(own**2)) / max(float(np.mean(own)) ** 2, 1e-300)
    return variance, floor / square * float(np.sqrt(2.0 * max(unlike, 1.0) / kept))


def _mean_product(
    first: Float32[np.ndarray, "rows columns"], second: Float32[np.ndarray, "rows columns"], count: int
) -> float:
    """Mean over so many pixels, without a copy; sums by rows keep single precision exact enough."""
    return float(np.einsum("ij,ij->i", first, second).sum(dtype=np.float64)) / count


def rough_median(picture: Picture) -> float:
    """Median over some 128 evenly drawn rows, an odd number apart: of all rows of a mosaic alike."""
    return float(np.median(picture[:: int(picture.shape[0] // 128) | 1]))


def white_coefficients(
    powers: list[Float32[np.ndarray, "rows columns"]], taken: tuple[int, int], rules: NoiseRules
) -> Bool[np.ndarray, "rows columns"]:
    """Coefficients of cosine transforms that hold white noise alone; all transforms are of the same light.

    The first line and column hold what differs by rows and by columns: they are never among them.

    Args:
        powers: squared coefficients, one picture per colour site.
        taken: so many of the lowest rows and columns were changed by taking off shading.
        rules: what is light, and how far it reaches.
    """
    rows, columns = powers[0].shape
    keep = np.ones((rows, columns), bool)
    keep[0], keep[:, 0] = False, False
    keep[: taken[0], : taken[1]] = False
    block = min(_BLOCK, rows // 4, columns // 4)
    if block < 2:
        return keep
    count = _by_block(keep, block)
    pooled = np.zeros(count.shape)
    for power in powers:
        total = _by_block(power * keep, block)
        pooled += total / max(_floor(count, total), 1e-300)
    seen = _light(count * len(powers), pooled, rules.light_sigma)
    wide = _reached(seen, rules.light_reach)
    left_out = wide if count[~wide].sum() >= rules.light_least * keep.size else seen
    white = np.zeros_like(keep)
    blocks = np.repeat(np.repeat(~left_out, block, axis=0), block, axis=1)
    white[: blocks.shape[0], : blocks.shape[1]] = blocks
    return white & keep


def _by_block(values: np.ndarray, block: int) -> Grid:
    """Sums over blocks; coefficients that fill no block are left out."""
    high, wide = (n // block * block for n in values.shape)
    # Rows first: sums along contiguous memory are the slow part.
    by_row = np.add.reduce(values[:high, :wide].reshape(high, wide // block, block), axis=2, dtype=np.float32)
    return by_row.reshape(high // block, block, wide // block).sum(axis=1, dtype=np.float64)


def _floor(count: Grid, total: Grid) -> float:
    """Power of the floor from a low quantile of the blocks, put right for its being low."""
    full = count >= count.max()
    low = float(np.quantile(total[full] / count[full], _QUANTILE))
    return low / _mean_square(count.max(keepdims=True), float(ndtri(_QUANTILE))).item()


def _mean_square(count: Float[np.ndarray, "*n"], z: float) -> Float[np.ndarray, "*n"]:
    """The mean of so many squared normals that is ``z`` sigma high, by Wilson and Hilferty (PNAS 17, 1931)."""
    spread = 2 / (9 * np.maximum(count, 1))
    return np.asarray((1 - spread + z * np.sqrt(spread)) ** 3)


def _light(count: Grid, total: Grid, sigma: float) -> Mask:
    """Blocks with more power than the floor, alone or as part of a rectangle; small rectangles are tested first.

    Args:
        count: coefficients per block, those of all sites together.
        total: their power over the floor's.
        sigma: what is more than chance.
    """
    light = np.zeros(count.shape, bool)
    floor = _floor(count, total)
    for _ in range(_ROUNDS):
        before = light.copy()
        for side in _SIDES:
            if side[0] <= len(count) and side[1] <= count.shape[1]:
                number, power = (_sums(np.where(light, 0.0, part), side) for part in (count, total))
                high = power / np.maximum(number, 1) > max(floor, 1e-300) * _mean_square(number, sigma)
                light |= _covered(high, side) & (count > 0)
        floor = float(total[~light].sum()) / max(float(count[~light].sum()), 1.0)
        if np.array_equal(before, light):
            break
    return light


def _sums(values: Grid, side: tuple[int, int]) -> Grid:
    """Sums over the rectangles that begin at each block; those that reach over the end are cut there."""
    sums = cv2.boxFilter(values, -1, side[::-1], anchor=(0, 0), normalize=False, borderType=cv2.BORDER_CONSTANT)
    return np.maximum(sums, 0.0)


def _covered(high: Mask, side: tuple[int, int]) -> Mask:
    """Blocks of the rectangles that are high; those half a side apart are looked at."""
    marks = np.zeros(high.shape, np.uint8)
    apart = tuple(np.s_[:: max(length // 2, 1)] for length in side)
    marks[apart] = high[apart]
    return cv2.dilate(marks, np.ones(side, np.uint8), anchor=(side[1] - 1, side[0] - 1)) > 0


def _reached(seen: Mask, reach: float) -> Mask:
    """All blocks at lower frequencies than ``reach`` times those seen."""
    reached = np.zeros_like(seen)
    for row, column in np.argwhere(seen):
        reached[: int(np.ceil(reach * (row + 1))), : int(np.ceil(reach * (column + 1)))] = True
    return reached
