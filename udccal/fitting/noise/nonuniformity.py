"""What differs from row to row and pixel to pixel in the dark: row noise, DSNU, hot pixels (EMVA 1288, clause 8)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy.optimize import minimize_scalar

from udccal.fitting.noise.moments import RowMoments

# Samples this many robust sigma from the rest are defects, not non-uniformity.
OUTLIER_SIGMA = 6.0


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
    bad = far_off(about)
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
        places=first_places(bad),
    )


def far_off(
    values: Float[np.ndarray, "rows columns"] | Float32[np.ndarray, "rows columns"],
) -> Bool[np.ndarray, "rows columns"]:
    """Samples more than 6 robust sigma from the median."""
    sample = values[:: max(1, values.shape[0] // 256)]
    middle = float(np.median(sample))
    spread = 1.4826 * float(np.median(np.abs(sample - middle)))
    # Averages of few frames are coarse: a spread below their step is no measure of what is usual.
    reach = OUTLIER_SIGMA * max(spread, float(sample.std()) / OUTLIER_SIGMA, 1e-12)
    return (values > middle + reach) | (values < middle - reach)


def first_places(bad: Bool[np.ndarray, "rows columns"]) -> tuple[tuple[int, int], ...]:
    """Row and column of the first eight."""
    rows, columns = np.unravel_index(np.flatnonzero(bad)[:8], bad.shape)
    return tuple(zip(rows.tolist(), columns.tolist(), strict=True))


def rough_median(picture: Float[np.ndarray, "rows columns"] | Float32[np.ndarray, "rows columns"]) -> float:
    """Median over some evenly drawn rows of all colours."""
    return float(np.median(picture[:: _odd_step(picture)]))


def _odd_step(picture: np.ndarray) -> int:
    """So many rows apart that about 128 are drawn, from all rows of a mosaic alike."""
    return int(picture.shape[0] // 128) | 1


def count_hot(dark_DN: Float[np.ndarray, "rows columns"] | Float32[np.ndarray, "rows columns"]) -> int:
    """Pixels of an averaged dark frame more than 8 robust sigma (and at least 2 DN) above the median."""
    sample = dark_DN[:: _odd_step(dark_DN)]
    middle = float(np.median(sample))
    spread = 1.4826 * float(np.median(np.abs(sample - middle)))
    return int(np.sum(dark_DN > middle + max(8 * spread, 2.0)))
