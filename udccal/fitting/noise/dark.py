"""All that dark frames tell: black, dark current, read noise and its shape, row noise, DSNU; each if it is there."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from udccal.fitting.engine.gaussian import scaled_inverse
from udccal.fitting.noise import codes, nonuniformity, read_noise
from udccal.fitting.noise.density import NORMAL_SHAPE, excess_kurtosis
from udccal.fitting.noise.moments import RowMoments, StackMoments
from udccal.result import Candidate

# Where the mean code follows black to this, rounding is white and nothing is cut off: plain moments are exact.
_WHITE = 0.005
# Rounding's first harmonic in the variance of a pixel is down by this (natural logarithm).
_SMEARED = 6.0
# Below so much of a code, rounding decides which samples differ; a model of independent samples is no measure then.
_RESOLVED = 0.15
# Of row noise that follows black to less than this nothing can be said.
_VISIBLE = 0.2


@dataclass(frozen=True)
class DarkFrames:
    """Dark pairs as histograms, their row noise, and the averaged dark stack."""

    pairs: tuple[codes.DarkPair, ...]
    rows: tuple[RowMoments, ...]
    stack: StackMoments
    q_DN: int


@dataclass(frozen=True)
class Quantity:
    """A value with its variance; where ``there`` is False the data do not ask for it and the value is that without."""

    value: float
    variance: float
    there: bool = True

    def candidates(self, name: str, gain: float, penalty: float) -> tuple[Candidate, Candidate]:
        """Without and with this term, by BIC: ``gain`` is in minus twice the log-likelihood."""
        without, with_ = max(gain - penalty, 0.0), max(penalty - gain, 0.0)
        return (
            Candidate(f"without {name}", 0, without, not self.there),
            Candidate(f"with {name}", 1, with_, self.there),
        )


@dataclass(frozen=True)
class DarkTerms:
    """Dark quantities in DN.

    ``K_DN_per_e`` is the gain that was taken for known; ``read_DN2`` is the variance of single samples without row
    noise; ``levels_cov`` that of (black, dark current); ``excess`` the excess kurtosis of the read noise;
    ``pixels_DN2`` the variance of the mean of this sensor's offsets; ``histogram_values`` what a refit begins from.
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
    edge_gain: float
    converged: bool
    iterations: int
    histogram_values: Float[np.ndarray, "5"]
    samples: int
    defects: nonuniformity.Unevenness
    candidates: tuple[Candidate, ...]


def row_quantity(
    frames: DarkFrames, edge_gains: Float[np.ndarray, " pairs"] | None = None
) -> tuple[Quantity, tuple[Candidate, Candidate]]:
    """Row noise; rounding and cut-off codes pass only the square of ``edge_gains`` of it, pair by pair."""
    gains = np.ones(len(frames.pairs)) if edge_gains is None else edge_gains
    moments = [_undamped(rows, float(gain)) for rows, gain in zip(frames.rows, gains, strict=True)]
    if frames.stack.temporal is not None:
        nearest = int(np.argmin([abs(pair.exposure_s - frames.stack.exposure_s) for pair in frames.pairs]))
        moments.append(_undamped(frames.stack.temporal.rows, float(gains[nearest])))
    step2 = frames.q_DN**2 / 12.0
    seen = tuple(rows for rows in moments if rows is not None and rows.variance_DN2 + rows.sampling_DN2 > 0)
    if not seen:
        # Rounding hides all of it: it may be as large as rounding itself.
        nothing = Quantity(0.0, step2**2, False)
        return nothing, nothing.candidates("row noise", 0.0, 1.0)
    found = nonuniformity.combine_rows(seen)
    penalty = float(np.log(max(sum(int(pair.counts.sum()) for pair in frames.pairs), 2)))
    there = bool(found.gain > penalty)
    value = Quantity(found.variance_DN2 if there else 0.0, found.sigma_DN2**2, there)
    return value, value.candidates("row noise", found.gain, penalty)


def _undamped(rows: RowMoments, gain: float) -> RowMoments | None:
    if gain < _VISIBLE:
        return None
    return RowMoments(rows.variance_DN2 / gain**2, rows.sampling_DN2 / gain**2, rows.dof)


def _unresolved(frames: DarkFrames, fit: read_noise.DarkFit, known: read_noise.Surroundings) -> bool:
    """Temporal noise too small beside a code to be told from the pattern of rounding."""
    temporal = float(fit.values[2]) + known.sigma_row_DN**2
    return temporal < (_RESOLVED * frames.q_DN) ** 2


def fit_dark_terms(frames: DarkFrames, K_DN_per_e: float, start: DarkTerms | None = None) -> DarkTerms:
    """Fit everything dark; ``K_DN_per_e`` is used for the shot noise of the dark current alone.

    ``start`` is a fit with another gain to begin from.
    """
    row, row_table = row_quantity(frames)
    known = _known(frames, K_DN_per_e, row, None)
    tukey = read_noise.fit_dark(frames.pairs, known, start=None if start is None else start.histogram_values)
    if not _follows(tukey):
        row, row_table = row_quantity(frames, tukey.edge_gains)
        known = _known(frames, K_DN_per_e, row, tukey.edge_gains)
        tukey = read_noise.fit_dark(frames.pairs, known, start=tukey.values)
    if _unresolved(frames, tukey, known):
        row, row_table = row_quantity(frames, np.zeros(len(frames.pairs)))
    samples = sum(int(pair.counts.sum()) for pair in frames.pairs)
    penalty = float(np.log(max(samples, 2)))
    gain = (float(tukey.values[4]) - NORMAL_SHAPE) ** 2 / float(tukey.cov[4, 4])
    shaped = bool(gain > penalty)
    chosen = tukey if shaped else read_noise.fit_dark(frames.pairs, known, start=tukey.values, normal=True)
    shape = Quantity(float(chosen.values[4]), float(tukey.cov[4, 4]), shaped)
    follows = _follows(chosen)
    # Offsets that differ smear the rounding of the mean over all pixels; that of one pixel, its own noise alone.
    white = follows and 4 * np.pi**2 * float(chosen.values[2]) >= _SMEARED * frames.q_DN**2
    rough = max(float(chosen.values[1]), 0.0)
    unevenness = _dsnu(frames, chosen, known, white, K_DN_per_e * rough)
    levels, levels_cov, current, current_table = _levels(frames, chosen, known, follows, unevenness, penalty)
    dsnu_gain = (unevenness.variance / unevenness.sigma) ** 2 if unevenness.variance > 0 else 0.0
    dsnu_penalty = float(np.log(max(unevenness.samples, 2)))
    uneven = bool(dsnu_gain > dsnu_penalty)
    dsnu = Quantity(unevenness.variance if uneven else 0.0, unevenness.sigma**2, uneven)
    return DarkTerms(
        K_DN_per_e=K_DN_per_e,
        black_DN=levels,
        dark_DN_per_s=current,
        levels_cov=levels_cov,
        read_DN2=_read(chosen),
        shape=shape,
        excess=excess_kurtosis(shape.value) if shaped else 0.0,
        row_DN2=row,
        dsnu_DN2=dsnu,
        pixels_DN2=unevenness.mean_variance,
        white=white,
        edge_gain=float(np.sqrt(np.mean(chosen.edge_gains**2))),
        converged=chosen.converged,
        iterations=tukey.iterations,
        histogram_values=tukey.values,
        samples=samples,
        defects=unevenness,
        candidates=(
            *row_table,
            *shape.candidates(f"read noise of another shape than normal ({NORMAL_SHAPE:.2f})", gain, penalty),
            *current_table,
            *dsnu.candidates("DSNU", dsnu_gain, dsnu_penalty),
        ),
    )


def _known(
    frames: DarkFrames, K_DN_per_e: float, row: Quantity, edge_gains: Float[np.ndarray, " pairs"] | None
) -> read_noise.Surroundings:
    """Row noise as it happened to be in the pairs alone: that is what widened their histograms."""
    if not row.there:
        return read_noise.Surroundings(K_DN_per_e, 0.0)
    alone = replace(frames, stack=replace(frames.stack, temporal=None))
    return read_noise.Surroundings(K_DN_per_e, float(np.sqrt(row_quantity(alone, edge_gains)[0].value)))


def _read(fit: read_noise.DarkFit) -> Quantity:
    if float(fit.values[2]) <= 1.001 * read_noise.LEAST_VARIANCE:
        return Quantity(0.0, max(float(fit.cov[2, 2]), read_noise.LEAST_VARIANCE**2), False)
    return Quantity(float(fit.values[2]), float(fit.cov[2, 2]))


def _follows(fit: read_noise.DarkFit) -> bool:
    """Mean codes follow the mean signal: nothing is cut off."""
    return bool(np.abs(fit.edge_gains - 1).max() < _WHITE)


def _dsnu(
    frames: DarkFrames, fit: read_noise.DarkFit, known: read_noise.Surroundings, white: bool, shot_DN2_per_s: float
) -> nonuniformity.Unevenness:
    """From the stack's average, unless rounding bends it: then from the histograms."""
    stack = frames.stack
    temporal = float(fit.values[2]) + shot_DN2_per_s * stack.exposure_s + frames.q_DN**2 / 12.0
    row = known.sigma_row_DN**2 / stack.frames
    found = nonuniformity.dsnu(stack.mean_DN, temporal / stack.frames, row)
    if white:
        return found
    variance, pixels = float(fit.values[3]), stack.mean_DN.size
    sigma = float(np.sqrt(fit.cov[3, 3]))
    if _unresolved(frames, fit, known):
        sigma = float(np.hypot(sigma, frames.q_DN**2 / 12.0))
    return replace(found, variance=variance, sigma=sigma, samples=pixels, mean_variance=variance / pixels)


def _levels(
    frames: DarkFrames,
    fit: read_noise.DarkFit,
    known: read_noise.Surroundings,
    follows: bool,
    unevenness: nonuniformity.Unevenness,
    penalty: float,
) -> tuple[float, Float[np.ndarray, "2 2"], Quantity, tuple[Candidate, ...]]:
    """Black and dark current from the mean of every dark exposure, with its own weight."""
    means, variances = read_noise.dark_levels(frames.pairs, fit, known)
    times = np.array([pair.exposure_s for pair in frames.pairs])
    stack = frames.stack
    if follows:
        drift = max(float(fit.values[1]), 0.0) * stack.exposure_s
        single = float(fit.values[2]) + known.K_DN_per_e * drift + frames.q_DN**2 / 12.0
        rows = known.sigma_row_DN**2 / stack.mean_DN.shape[0]
        means = np.append(means, unevenness.mean)
        variances = np.append(variances, (single / stack.mean_DN.size + rows) / stack.frames)
        times = np.append(times, stack.exposure_s)
    line, cov = _line(times, means, variances)
    gain = float(line[1] ** 2 / cov[1, 1]) if cov[1, 1] > 0 else 0.0
    there = bool(gain > penalty and line[1] > 0)
    current = Quantity(float(line[1]) if there else 0.0, float(cov[1, 1]), there)
    table = current.candidates("dark current", gain if line[1] > 0 else 0.0, penalty)
    # The offsets of this sensor's pixels are one draw: their mean is not that of all sensors alike.
    cov[0, 0] += unevenness.mean_variance
    if not follows:
        # Black, spread and noise of coarse or cut-off codes err together, and alike in every pair.
        cov[0, 0] = max(float(cov[0, 0]), len(frames.pairs) * float(fit.cov[0, 0]))
    if any(variance >= frames.q_DN**2 / 12.0 for variance in variances):
        # What rounding hides is hidden alike in every exposure.
        cov[0, 0] += frames.q_DN**2 / 12.0
    # Black stays that of the line: a dark current too weak to be chosen must not pull it.
    return float(line[0]), cov, current, table


def _line(
    times: Float[np.ndarray, " n"], means: Float[np.ndarray, " n"], variances: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2 2"]]:
    design = np.column_stack([np.ones_like(times), times])
    cov = scaled_inverse(design.T @ (design / variances[:, None]))
    return cov @ (design.T @ (means / variances)), cov
