"""All that dark frames tell: black, dark current, read noise and its shape, row noise, DSNU; each if it is there."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import numpy as np
from jaxtyping import Bool, Float, Float32

from udccal.fitting.engine.gaussian import scaled_inverse
from udccal.fitting.engine.orders import Attempt, bic, choose
from udccal.fitting.engine.robust import MAD_TO_SIGMA
from udccal.fitting.noise.codes import (
    LEAST_VARIANCE,
    NORMAL_SHAPE,
    DarkFit,
    Surroundings,
    dark_levels,
    excess_kurtosis,
    fit_dark,
)
from udccal.fitting.noise.data import NoiseMoments
from udccal.fitting.noise.rules import NoiseRules
from udccal.result import Candidate


@final
@dataclass(frozen=True)
class Quantity:
    """A value with its variance; where ``there`` is False the data do not ask for it and the value is that without."""

    value: float
    variance: float
    there: bool = True
    candidates: tuple[Candidate, ...] = ()

    @classmethod
    def asked(
        cls, name: str, value: float, variance: float, samples: int, gain: float | None = None, without: float = 0.0
    ) -> Quantity:
        """The value where the likelihood gains more by it (minus twice the logarithm) than BIC asks."""
        own = value**2 / variance if value > 0 and variance > 0 else 0.0
        choice = choose(
            (
                Attempt(f"without {name}", 0, own if gain is None else gain, without),
                Attempt(f"with {name}", 1, bic(0.0, 1.0, samples), value),
            )
        )
        return cls(choice.best.fit, variance, choice.best.parameters > 0, choice.candidates)


@final
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


@final
@dataclass(frozen=True)
class DarkTerms:
    """Dark quantities in DN.

    ``K_DN_per_e`` is the gain that was taken for known; ``read_DN2`` is the variance of single samples without row
    noise, and ``excess`` its excess kurtosis; ``levels_cov`` is the covariance of (black, dark current);
    ``pixels_DN2`` the variance of the mean of this sensor's offsets.
    """

    K_DN_per_e: float
    black_DN: float
    dark_DN_per_s: Quantity
    levels_cov: Float[np.ndarray, "2 2"]
    read_DN2: Quantity
    shape: Quantity
    excess: float
    row_DN2: Quantity
    dsnu_DN2: Quantity
    pixels_DN2: float
    white: bool
    fit: DarkFit
    samples: int
    defects: Unevenness


def fit_dark_terms(
    data: NoiseMoments, K_DN_per_e: float, rules: NoiseRules, start: DarkTerms | None = None
) -> DarkTerms:
    """Fit everything dark; ``K_DN_per_e`` is used for the shot noise of the dark current alone.

    ``start`` is a fit with another gain to begin from.
    """
    row, in_pairs = row_noise(data, rules, np.ones(len(data.darks)))
    known = Surroundings(K_DN_per_e, in_pairs, rules.background)
    tukey = fit_dark(data.darks, known, rules, start=None if start is None else start.fit.values)
    if not _follows(tukey, rules):
        row, in_pairs = row_noise(data, rules, tukey.edge_gains)
        known = replace(known, sigma_row_DN=in_pairs)
        tukey = fit_dark(data.darks, known, rules, start=tukey.values)
    # Temporal noise too small beside a code is not told from the pattern of rounding.
    resolved = float(tukey.values[2]) + known.sigma_row_DN**2 >= (rules.resolved * data.q_DN) ** 2
    row = row if resolved else row_noise(data, rules, np.zeros(len(data.darks)))[0]
    samples = sum(int(pair.counts.sum()) for pair in data.darks)
    told, variance = float(tukey.values[4]), float(tukey.cov[4, 4])
    name = f"read noise of another shape than normal ({NORMAL_SHAPE:.2f})"
    gain = (told - NORMAL_SHAPE) ** 2 / variance
    shape = Quantity.asked(name, told, variance, samples, gain, without=NORMAL_SHAPE)
    fit = tukey if shape.there else fit_dark(data.darks, known, rules, start=tukey.values, normal=True)
    # Offsets that differ smear the rounding of the mean over all pixels; that of one pixel, its own noise alone.
    white = _follows(fit, rules) and 4 * np.pi**2 * float(fit.values[2]) >= rules.smeared * data.q_DN**2
    uneven = _dsnu(data, fit, known, white, resolved, rules)
    black, levels_cov, current = _levels(data, fit, known, _follows(fit, rules), uneven)
    none = float(fit.values[2]) <= 1.001 * LEAST_VARIANCE
    read_variance = max(float(fit.cov[2, 2]), LEAST_VARIANCE**2) if none else float(fit.cov[2, 2])
    return DarkTerms(
        K_DN_per_e=K_DN_per_e,
        black_DN=black,
        dark_DN_per_s=current,
        levels_cov=levels_cov,
        read_DN2=Quantity(0.0 if none else float(fit.values[2]), read_variance, not none),
        shape=shape,
        excess=excess_kurtosis(shape.value) if shape.there else 0.0,
        row_DN2=row,
        dsnu_DN2=Quantity.asked("DSNU", uneven.variance, uneven.sigma**2, uneven.samples),
        pixels_DN2=uneven.mean_variance,
        white=white,
        fit=replace(fit, values=tukey.values),
        samples=samples,
        defects=uneven,
    )


def row_noise(data: NoiseMoments, rules: NoiseRules, edge_gains: Float[np.ndarray, " pairs"]) -> tuple[Quantity, float]:
    """Variance by rows, and its root as it happened to be in the pairs alone: that is what widened their histograms.

    Rounding and cut-off codes pass only the square of ``edge_gains`` of it, pair by pair.
    """
    seen = [(one.rows, float(gain)) for one, gain in zip(data.dark_moments, edge_gains, strict=True)]
    samples = sum(int(pair.counts.sum()) for pair in data.darks)

    def told() -> Quantity:
        rows = [
            ((of.variance_DN2 + of.sampling_DN2) / gain**2, of.sampling_DN2 / gain**2, of.dof)
            for of, gain in seen
            if gain >= rules.row_visible and of.variance_DN2 + of.sampling_DN2 > 0
        ]
        # Where rounding hides all of it, it may be as large as rounding itself.
        found = excess_variance(*np.array(rows).T) if rows else (0.0, (data.q_DN**2 / 12.0) ** 2, 0.0)
        return Quantity.asked("row noise", found[0], found[1], samples, found[2])

    alone = told()
    if data.dark_stack.temporal is not None:
        nearest = int(np.argmin([abs(pair.exposure_s - data.dark_stack.exposure_s) for pair in data.darks]))
        seen.append((data.dark_stack.temporal.rows, float(edge_gains[nearest])))
    row = told()
    return row, float(np.sqrt(alone.value)) if row.there else 0.0


def excess_variance(
    observed: Float[np.ndarray, " n"], known: Float[np.ndarray, " n"], dof: Float[np.ndarray, " n"]
) -> tuple[float, float, float]:
    """Variance that chi-squared estimates have beside what is known of them, by maximum likelihood; not below 0.

    Args:
        observed: estimates of a variance.
        known: part of each that has another cause.
        dof: degrees of freedom of each.

    Returns:
        the variance, its own variance, and what the likelihood gains by it (minus twice the logarithm).
    """
    known = known + 1e-12 * float(observed.max()) + 1e-300
    found = float(np.average(observed, weights=dof))
    for _ in range(50):
        weight = dof / (found + known) ** 2
        found = max(float(np.sum(weight * (observed - known)) / np.sum(weight)), 0.0)

    def deviance(variance: float) -> float:
        return float(np.sum(dof * (np.log(variance + known) + observed / (variance + known))))

    return found, float(2 / np.sum(dof / (found + known) ** 2)), deviance(0.0) - deviance(found)


def _follows(fit: DarkFit, rules: NoiseRules) -> bool:
    """Mean codes follow the mean signal: nothing is cut off."""
    return bool(np.abs(fit.edge_gains - 1).max() < rules.white)


def _dsnu(
    data: NoiseMoments, fit: DarkFit, known: Surroundings, white: bool, resolved: bool, rules: NoiseRules
) -> Unevenness:
    """From the stack's average, unless rounding bends it: then from the histograms."""
    stack = data.dark_stack
    shot = known.K_DN_per_e * max(float(fit.values[1]), 0.0) * stack.exposure_s
    temporal = float(fit.values[2]) + shot + data.q_DN**2 / 12.0
    found = dsnu(stack.mean_DN, temporal / stack.frames, known.sigma_row_DN**2 / stack.frames, rules)
    if white:
        return found
    variance, pixels = float(fit.values[3]), stack.mean_DN.size
    sigma = float(np.hypot(np.sqrt(fit.cov[3, 3]), 0.0 if resolved else data.q_DN**2 / 12.0))
    return replace(found, variance=variance, sigma=sigma, samples=pixels, mean_variance=variance / pixels)


def dsnu(
    dark_DN: Float[np.ndarray, "rows columns"] | Float32[np.ndarray, "rows columns"],
    temporal_DN2: float,
    row_DN2: float,
    rules: NoiseRules,
) -> Unevenness:
    """Variance of the pixels' offsets in an averaged dark frame (EMVA 1288, clause 8.2), row and column patterns in it.

    Args:
        dark_DN: the average.
        temporal_DN2: temporal variance of one sample of the average, row noise left out.
        row_DN2: row noise left in the average.
        rules: which pixels are defects.
    """
    about = dark_DN.astype(np.float64)
    bad = _far_off(about, rules.defect_sigma)
    mean = float(about[~bad].mean()) if not bad.all() else 0.0
    about -= mean
    about[bad] = 0.0
    rows, columns = about.shape
    samples = int(about.size - bad.sum())
    total = float(np.vdot(about, about)) / max(samples - 1, 1)
    row_part, column_part = float(np.var(about.mean(axis=1))), float(np.var(about.mean(axis=0)))
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


def _far_off(values: Float[np.ndarray, "rows columns"], reach: float) -> Bool[np.ndarray, "rows columns"]:
    """Samples more than ``reach`` robust sigma from the median."""
    sample = values[:: max(1, values.shape[0] // 256)]
    middle = float(np.median(sample))
    spread = MAD_TO_SIGMA * float(np.median(np.abs(sample - middle)))
    # Averages of few frames are coarse: a spread below their step is no measure of what is usual.
    return np.abs(values - middle) > reach * max(spread, float(sample.std()) / reach, 1e-12)


def first_places(bad: Bool[np.ndarray, "rows columns"]) -> tuple[tuple[int, int], ...]:
    """Row and column of the first eight."""
    rows, columns = np.unravel_index(np.flatnonzero(bad)[:8], bad.shape)
    return tuple(zip(rows.tolist(), columns.tolist(), strict=True))


def _levels(
    data: NoiseMoments, fit: DarkFit, known: Surroundings, follows: bool, uneven: Unevenness
) -> tuple[float, Float[np.ndarray, "2 2"], Quantity]:
    """Black and dark current from the mean of every dark exposure, with its own weight."""
    means, variances = dark_levels(data.darks, fit, known)
    times = np.array([pair.exposure_s for pair in data.darks])
    stack, rounding = data.dark_stack, data.q_DN**2 / 12.0
    if follows:
        single = float(fit.values[2]) + known.K_DN_per_e * max(float(fit.values[1]), 0.0) * stack.exposure_s + rounding
        rows = known.sigma_row_DN**2 / stack.mean_DN.shape[0]
        means, times = np.append(means, uneven.mean), np.append(times, stack.exposure_s)
        variances = np.append(variances, (single / stack.mean_DN.size + rows) / stack.frames)
    design = np.column_stack([np.ones_like(times), times])
    cov = scaled_inverse(design.T @ (design / variances[:, None]))
    line = cov @ (design.T @ (means / variances))
    samples = sum(int(pair.counts.sum()) for pair in data.darks)
    current = Quantity.asked("dark current", float(line[1]), float(cov[1, 1]), samples)
    # The offsets of this sensor's pixels are one draw: their mean is not that of all sensors alike.
    cov[0, 0] += uneven.mean_variance
    if not follows:
        # Black, spread and noise of coarse or cut-off codes err together, and alike in every pair.
        cov[0, 0] = max(float(cov[0, 0]), len(data.darks) * float(fit.cov[0, 0]))
    if (variances >= rounding).any():
        # What rounding hides is hidden alike in every exposure.
        cov[0, 0] += rounding
    # Black stays that of the line: a dark current too weak to be chosen must not pull it.
    return float(line[0]), cov, current
