"""What differs from row to row and pixel to pixel: row noise, DSNU, PRNU, hot pixels (EMVA 1288, clause 8; ELD)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy.fft import dctn
from scipy.optimize import minimize_scalar

from udccal.fitting.noise_moments import RowMoments

# Samples this many robust sigma from the rest are defects, not non-uniformity.
OUTLIER_SIGMA = 6.0
# Side of the window that follows shading, in samples of one colour.
_WINDOW = 63
# Coefficients per block of the spectrum, and how far above the floor a block is something else than pixels.
_BLOCK, _ABOVE = 16, 5.0


@dataclass(frozen=True)
class Unevenness:
    """A variance between pixels (may be negative by chance), its standard deviation, samples, and outliers left out.

    ``mean`` is that of the samples left in, and ``mean_variance`` how much it differs from sensor to sensor by these
    patterns alone; ``places`` are (row, column) of the first outliers.
    """

    variance: float
    sigma: float
    samples: int
    outliers: int
    mean: float
    mean_variance: float
    places: tuple[tuple[int, int], ...] = ()


@dataclass(frozen=True)
class RowNoise:
    """sigma_row^2 in DN^2 with its sigma, and how much the likelihood gains by it (minus twice the logarithm)."""

    variance_DN2: float
    sigma_DN2: float
    gain: float
    dof: float


def combine_rows(moments: tuple[RowMoments, ...]) -> RowNoise:
    """Row noise by maximum likelihood: each variance of row means is chi-squared about sigma_row^2 + its sampling."""
    sampling = np.array([m.sampling_DN2 for m in moments])
    observed = np.maximum([m.variance_DN2 + m.sampling_DN2 for m in moments], 1e-300)
    dof = np.array([m.dof for m in moments])
    floor = 1e-12 + 1e-9 * float(observed.max(initial=0.0))

    def deviance(variance: float) -> float:
        expected = variance + sampling + floor
        return float(np.sum(dof * (np.log(expected) + observed / expected)))

    top = float(observed.max()) + floor
    found = minimize_scalar(deviance, bounds=(0.0, top), method="bounded", options={"xatol": 1e-7 * top})
    # The bounded search never lands on the bound itself.
    variance = float(found.x) if deviance(0.0) > float(found.fun) else 0.0
    information = float(np.sum(0.5 * dof / (variance + sampling + floor) ** 2))
    return RowNoise(variance, 1 / np.sqrt(information), deviance(0.0) - deviance(variance), float(dof.sum()))


def dsnu(
    dark_DN: Float[np.ndarray, "rows columns"] | Float32[np.ndarray, "rows columns"],
    temporal_DN2: float,
    row_DN2: float,
) -> Unevenness:
    """Variance of the pixels' offsets in an averaged dark frame (EMVA 1288, clause 8.2), row and column patterns in it.

    Args:
        dark_DN: the average.
        temporal_DN2: temporal variance of one sample of the average, row noise left out.
        row_DN2: row noise left in the average.
    """
    about = dark_DN.astype(np.float64)
    bad = _far_off(about)
    mean = float(about[~bad].mean()) if not bad.all() else 0.0
    about -= mean
    about[bad] = 0.0
    rows, columns = about.shape
    by_row, by_column = about.mean(axis=1), about.mean(axis=0)
    samples = int(about.size - bad.sum())
    total = float(np.vdot(about, about)) / max(samples - 1, 1)
    row_part, column_part = float(np.var(by_row)), float(np.var(by_column))
    pixel_part = max(total - row_part - column_part, 0.0)
    # Each part is chi-squared with its own number of independent values.
    sigma = np.sqrt(2 * pixel_part**2 / samples + 2 * row_part**2 / rows + 2 * column_part**2 / columns)
    own_row, own_column = (max(part - pixel_part / n, 0.0) for part, n in ((row_part, columns), (column_part, rows)))
    of_mean = max(pixel_part - temporal_DN2, 0.0) / samples + max(own_row - row_DN2, 0.0) / rows + own_column / columns
    return Unevenness(
        variance=total - temporal_DN2 - row_DN2,
        sigma=float(sigma),
        samples=samples,
        outliers=int(bad.sum()),
        mean=mean,
        mean_variance=float(of_mean),
        places=_places(bad),
    )


def _far_off(values: Float[np.ndarray, "rows columns"]) -> Bool[np.ndarray, "rows columns"]:
    sample = values[:: max(1, values.shape[0] // 256)]
    middle = float(np.median(sample))
    spread = 1.4826 * float(np.median(np.abs(sample - middle)))
    # Averages of few frames are coarse: a spread below their step is no measure of what is usual.
    return np.abs(values - middle) > OUTLIER_SIGMA * max(spread, float(sample.std()) / OUTLIER_SIGMA, 1e-12)


def _places(bad: Bool[np.ndarray, "rows columns"]) -> tuple[tuple[int, int], ...]:
    rows, columns = np.unravel_index(np.flatnonzero(bad)[:8], bad.shape)
    return tuple(zip(rows.tolist(), columns.tolist(), strict=True))


def prnu(
    signal_DN: Float[np.ndarray, "rows columns"] | Float32[np.ndarray, "rows columns"],
    temporal_DN2: float,
    shot_DN: float,
    period: int = 2,
) -> Unevenness:
    """Variance of the photo response, relative, behind shading and the panel's modulation (EMVA 1288, clause 8.3).

    The response of pixels is white; light is not. Per colour the picture is divided by its shading, and the floor of
    its spectrum (cosine transform) is taken: blocks of coefficients above the floor hold light, and the first line and
    column hold what differs by rows and columns; both are left out.

    Args:
        signal_DN: average of flats minus average of darks.
        temporal_DN2: temporal variance of one sample of it at no light.
        shot_DN: what a DN of signal adds to that variance, in DN^2 per DN.
        period: sites of the colour mosaic repeat after so many samples (1: monochrome).
    """
    parts = []
    for row in range(period):
        for column in range(period):
            site = np.ascontiguousarray(signal_DN[row::period, column::period], dtype=np.float32)
            parts.append(_prnu_of_site(site, temporal_DN2, shot_DN, (row, column), period))
    weights = np.array([1 / max(part.sigma, 1e-30) ** 2 for part in parts])
    variance = float(np.average([part.variance for part in parts], weights=weights))
    return Unevenness(
        variance,
        float(1 / np.sqrt(weights.sum())),
        sum(part.samples for part in parts),
        sum(part.outliers for part in parts),
        float(np.mean([part.mean for part in parts])),
        max(variance, 0.0) / max(sum(part.samples for part in parts), 1),
        sum((part.places for part in parts), ())[:8],
    )


def _prnu_of_site(
    site: Float32[np.ndarray, "rows columns"], temporal_DN2: float, shot_DN: float, at: tuple[int, int], period: int
) -> Unevenness:
    window = min(_WINDOW, (min(site.shape) // 4) * 2 + 1)
    level = cv2.blur(site, (window, window), borderType=cv2.BORDER_REFLECT_101)
    unlit = level <= 0
    level[unlit] = 1.0
    relative = site / level - np.float32(1)
    bad = _far_off(relative) | unlit
    relative[bad] = 0.0
    good = max(int(relative.size - bad.sum()), 1)
    power, kept = _floor(relative, window)
    observed = power * relative.size / good
    inverse_level = 1 / level[~bad].astype(np.float64) if not bad.all() else np.zeros(1)
    noise = float(np.mean(temporal_DN2 * inverse_level**2 + shot_DN * inverse_level))
    sigma = observed * np.sqrt(2.0 / max(kept, 1))
    places = tuple((period * row + at[0], period * column + at[1]) for row, column in _places(bad & ~unlit))
    return Unevenness(observed - noise, float(sigma), kept, int(bad.sum()), 0.0, 0.0, places)


def _floor(relative: Float32[np.ndarray, "rows columns"], window: int) -> tuple[float, int]:
    """Mean power of the coefficients that hold nothing but white noise, and their number."""
    power = np.square(dctn(relative, norm="ortho", workers=2))
    rows, columns = power.shape
    keep = np.ones(power.shape, bool)
    keep[0], keep[:, 0] = False, False
    # The window has taken its part of the lowest frequencies.
    keep[: 3 * rows // window + 1, : 3 * columns // window + 1] = False
    block = min(_BLOCK, rows // 4, columns // 4)
    if block < 2:
        return float(power[keep].mean()) if keep.any() else 0.0, int(keep.sum())
    high, wide = rows // block * block, columns // block * block
    shape = (rows // block, block, columns // block, block)
    count = keep[:high, :wide].reshape(shape).sum(axis=(1, 3))
    total = np.where(keep, power, 0)[:high, :wide].reshape(shape).sum(axis=(1, 3), dtype=np.float64)
    full = count == block * block
    means = total / np.maximum(count, 1)
    # A mean of m squared normals has its median at about 1 - 2 / (3 m) of itself.
    middle = float(np.median(means[full] if full.any() else means)) / (1 - 2 / (3 * block**2))
    for _ in range(8):
        above = means > middle * (1 + _ABOVE * np.sqrt(2.0 / np.maximum(count, 1)))
        used = ~above & (count > 0)
        before, middle = middle, float(total[used].sum() / max(count[used].sum(), 1))
        if abs(middle - before) <= 1e-6 * before:
            break
    return middle, int(count[used].sum())


def count_hot(dark_DN: Float[np.ndarray, "rows columns"] | Float32[np.ndarray, "rows columns"]) -> int:
    """Pixels of an averaged dark frame more than 8 robust sigma (and at least 2 DN) above the median."""
    middle = float(np.median(dark_DN))
    spread = 1.4826 * float(np.median(np.abs(dark_DN - middle)))
    return int(np.sum(dark_DN > middle + max(8 * spread, 2.0)))
