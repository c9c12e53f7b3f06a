"""PRNU: how the response differs from pixel to pixel, behind shading and a panel's modulation (EMVA 1288, 8.3)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy.fft import dctn

from udccal.fitting.noise.nonuniformity import OUTLIER_SIGMA, Unevenness, first_places, rough_median
from udccal.fitting.noise.spectrum import white_coefficients

# Side of the window that follows shading, in samples of one colour.
_WINDOW = 63
# Side of the window whose median stands for a defect.
_AROUND = 5
# Rows of a picture that tell how unlike its pixels' noise is: one in so many.
_SPARSE = 8


@dataclass(frozen=True)
class _Site:
    """One colour: signal over shading less one, that shading, what is no measure of either, and the spectrum."""

    relative: Float32[np.ndarray, "rows columns"]
    level_DN: Float32[np.ndarray, "rows columns"]
    bad: Bool[np.ndarray, "rows columns"]
    unlit: Bool[np.ndarray, "rows columns"]
    power: Float32[np.ndarray, "rows columns"]


def prnu(
    signal_DN: Float[np.ndarray, "rows columns"] | Float32[np.ndarray, "rows columns"],
    temporal_DN2: float,
    shot_DN: float,
    period: int = 2,
) -> Unevenness:
    """Variance of the photo response, relative.

    The response of pixels is white; light is not. Per colour the picture is divided by its shading, and the floor of
    its spectrum (cosine transform) is taken where ``noise.spectrum`` finds no light. Where the light is modulated the
    pixels' patterns are so as well: the floor is theirs times the mean square of the light.

    Args:
        signal_DN: average of flats minus average of darks.
        temporal_DN2: temporal variance of one sample of it at no light.
        shot_DN: what a DN of signal adds to that variance, in DN^2 per DN.
        period: sites of the colour mosaic repeat after so many samples (1: monochrome).
    """
    phases = [(row, column) for row in range(period) for column in range(period)]
    window = min(_WINDOW, (min(signal_DN.shape) // period // 4) * 2 + 1)
    sites = [_site(signal_DN[row::period, column::period], window) for row, column in phases]
    # The window has taken its part of the lowest frequencies. Sites may differ by a line: the least is common to all.
    rows, columns = (min(site.power.shape[axis] for site in sites) for axis in (0, 1))
    white = white_coefficients(
        [site.power[:rows, :columns] for site in sites], (3 * rows // window + 1, 3 * columns // window + 1)
    )
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


def _site(signal_DN: np.ndarray, window: int) -> _Site:
    site = np.ascontiguousarray(signal_DN, dtype=np.float32)
    level = cv2.blur(site, (window, window), borderType=cv2.BORDER_REFLECT_101)
    unlit = level <= 0
    level[unlit] = 1.0
    relative = site / level
    relative -= np.float32(1)
    bad = _defects(relative) | unlit
    relative[bad] = cv2.medianBlur(relative, _AROUND)[bad]
    power = dctn(relative, norm="ortho", workers=2)
    return _Site(relative, level, bad, unlit, np.square(power, out=power))


def _defects(relative: Float32[np.ndarray, "rows columns"]) -> Bool[np.ndarray, "rows columns"]:
    """Pixels 6 robust sigma from the middle of their neighbours both along the row and along the column.

    At the crests of deep waves of light pixels are off across the wave: that is no defect.
    """
    second = np.array([[-0.5, 1.0, -0.5]], np.float32)
    off = [np.abs(cv2.filter2D(relative, -1, kernel)) for kernel in (second, second.T)]
    usual = 1.4826 * min(rough_median(one) for one in off)
    return np.minimum(*off) > np.float32(OUTLIER_SIGMA * max(usual, 1e-12))


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
