"""Misfit: whether residuals have a pattern, how large it is, and how much it adds to error bars.

All terms follow one policy. Noise is independent from sample to sample; a misfit is not. Residuals are gathered in
groups that a misfit has in common (views, positions, tiles of the sensor, pictures) and tested against chance. The
misfit counts as found when chance makes it less than once in a thousand fits. Then (1) a note gives its size; (2) the
parameters' covariance is that of groups that differ by more than their noise; (3) predictions include its size.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import SupportsFloat, final

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import chdtrc, fdtrc

from udccal.fitting.engine.gaussian import scaled_inverse, square_root
from udccal.fitting.engine.robust import MAD_TO_SIGMA

# Chance finds a misfit where there is none once in a thousand fits.
SIGNIFICANT = 1e-3


@final
@dataclass(frozen=True)
class MisfitTest:
    """A statistic over its degrees of freedom (1 where the model holds), and how often chance makes it as large."""

    ratio: float
    p_value: float

    @property
    def found(self) -> bool:
        """Whether chance is no explanation."""
        return self.p_value < SIGNIFICANT

    @property
    def inflation(self) -> float:
        """Factor by which a variance is multiplied: 1 unless a misfit was found."""
        return max(self.ratio, 1.0) if self.found else 1.0


NO_TEST = MisfitTest(1.0, 1.0)


# Tails come from scipy.special: scipy.stats takes longer to load than everything else that a fit needs.
def chi2_tail(statistic: SupportsFloat, dof: SupportsFloat) -> float:
    """Probability that chi-squared of ``dof`` degrees of freedom is above ``statistic``; 1 where there are none."""
    return float(chdtrc(float(dof), max(float(statistic), 0.0))) if float(dof) > 0 else 1.0


def f_tail(statistic: SupportsFloat, above: SupportsFloat, below: SupportsFloat) -> float:
    """Probability that F is above ``statistic``; 1 where numerator or denominator has no degrees of freedom."""
    degrees = float(above), float(below)
    return float(fdtrc(*degrees, max(float(statistic), 0.0))) if min(degrees) > 0 else 1.0


def chi2_test(statistic: float, dof: float) -> MisfitTest:
    """Test a sum of squares of independent unit normals by chi-squared; ``NO_TEST`` without degrees of freedom."""
    return MisfitTest(statistic / dof, chi2_tail(statistic, dof)) if dof > 0 and np.isfinite(statistic) else NO_TEST


def f_test(statistic: float, rank: int, dof: float) -> MisfitTest:
    """F-test of a sum of squares whose scale was estimated from residuals that include it.

    The sum is part of the residuals behind the scale; it is therefore taken out of the denominator.

    Args:
        statistic: the sum, in units of the estimated variance.
        rank: its degrees of freedom.
        dof: degrees of freedom of all residuals behind the scale, those of ``rank`` included; without any left the
            result is ``NO_TEST``.
    """
    rest = dof - rank
    if rank < 1 or rest < 1 or not np.isfinite(statistic):
        return NO_TEST
    ratio = statistic / rank / (max(dof - statistic, 1e-9) / rest)
    return MisfitTest(float(ratio), f_tail(ratio, rank, rest))


def largest_test(z: Float[np.ndarray, " n"]) -> MisfitTest:
    """Test the largest of n independent unit normals, by its absolute value (Bonferroni's correction)."""
    largest = float(np.abs(z).max())
    return MisfitTest(largest, min(1.0, z.size * chi2_tail(largest**2, 1.0)))


def sharper(*tests: MisfitTest) -> MisfitTest:
    """The test of the lowest p-value, which is multiplied by the number of tests (Bonferroni's correction)."""
    best = min(tests, key=lambda t: t.p_value)
    return MisfitTest(best.ratio, min(1.0, len(tests) * best.p_value))


def group_means_test(
    z: Float[np.ndarray, " n"], group: Int[np.ndarray, " n"], used: Bool[np.ndarray, " n"], scale: float = 1.0
) -> MisfitTest:
    """Test by chi-squared whether means of groups scatter as those of independent residuals do.

    Args:
        z: residuals of the fit in units of their sigma.
        group: number of each sample's group, which has one degree of freedom.
        used: samples that count.
        scale: variance of ``z`` where the model holds.
    """
    count = np.bincount(group[used])
    total = np.bincount(group[used], z[used])
    seen = count > 0
    return chi2_test(float((total[seen] ** 2 / count[seen]).sum()) / scale, float(seen.sum()))


def excess_sigma(
    square: Float[np.ndarray, " n"],
    noise: Float[np.ndarray, " n"],
    unit: Float[np.ndarray, " n"],
    dof: float,
    chance: float = SIGNIFICANT,
) -> float:
    """Size of an error in addition to noise that brings chi-squared to its degrees of freedom; 0 if not significant.

    The estimate is that of Paule and Mandel (J. Res. NBS 87, 1982).

    Args:
        square: squared residuals.
        noise: variance of each residual by noise, in the same unit.
        unit: variance that an error of size 1 adds to each residual.
        dof: degrees of freedom.
        chance: how often chance may find an error where there is none; 0.5 gives an estimate wherever one is above 0.

    Returns:
        the size, one sigma, in units such that size^2 times ``unit`` is a variance.
    """
    if not unit.any() or chi2_tail(float((square / noise).sum()), dof) > chance:
        return 0.0
    found, most = 0.0, float(square.max() / unit[unit > 0].min())
    for _ in range(100):  # Newton's method: chi-squared is convex in the variance, so that no step goes too far.
        variance = noise + found * unit
        excess = float((square / variance).sum()) - dof
        if excess <= 1e-12 * dof or found == most:
            break
        found = min(found + excess / float((square * unit / variance**2).sum()), most)
    return float(np.sqrt(found))


def robust_excess_sigma(
    square: Float[np.ndarray, " n"], noise: Float[np.ndarray, " n"], unit: Float[np.ndarray, " n"]
) -> float:
    """The same by the median, which outliers hardly change, significant or not; arguments as for ``excess_sigma``."""
    seen = unit > 0
    # The variance that makes each residual just its probable error; half of the residuals lie below theirs.
    needed = (square[seen] * MAD_TO_SIGMA**2 - noise[seen]) / unit[seen]
    return float(np.sqrt(max(np.median(needed), 0.0))) if seen.any() else 0.0


def excess_variance(
    observed: Float[np.ndarray, " n"], known: Float[np.ndarray, " n"], dof: Float[np.ndarray, " n"]
) -> tuple[float, float, float]:
    """Maximum-likelihood variance of chi-squared estimates in addition to a known part; not below 0.

    Args:
        observed: estimates of a variance.
        known: part of each that has another cause, in the same unit.
        dof: degrees of freedom of each.

    Returns:
        the variance, its own variance, and what the likelihood gains by it (minus twice the logarithm).
    """
    known = known + 1e-12 * float(observed.max()) + 1e-300
    found = float(np.average(observed, weights=dof))
    for _ in range(50):
        found = max(float(np.average(observed - known, weights=dof / (found + known) ** 2)), 0.0)
    without, total = observed / known, observed / (found + known)
    gain = np.sum(dof * (np.log(known) + without - np.log(found + known) - total))
    return found, float(2 / np.sum(dof / (found + known) ** 2)), float(gain)


def clustered_cov(
    cov: Float[np.ndarray, "n n"],
    scores: Float[np.ndarray, "groups n"],
    information: Float[np.ndarray, "groups n n"] | None = None,
) -> Float[np.ndarray, "n n"]:
    """Covariance of parameters whose groups of data differ by more than their noise, never below ``cov``.

    The scatter of groups holds their noise already: along each direction the larger of the two counts, not their sum.
    Each group is left out in one Newton step (jackknife: Efron, CBMS 38, 1982). Without the groups' information the
    step uses ``cov`` alone (sandwich: Huber, Proc. 5th Berkeley Symposium, 1967).

    Args:
        cov: covariance of the fit by noise alone, other parameters marginalised.
        scores: minus half the gradient of each group's chi-squared at the minimum.
        information: half the Hessian of each group's chi-squared.

    Returns:
        n x n, in the units of ``cov``.
    """
    groups = len(scores)
    if groups < 2:
        return cov
    if information is None:
        shifts = scores @ cov
    else:
        matrix = np.linalg.pinv(cov, hermitian=True)
        shifts = np.stack(
            [np.linalg.pinv(matrix - own, hermitian=True) @ one for own, one in zip(information, scores, strict=True)]
        )
    spread = (shifts - shifts.mean(axis=0)) * np.sqrt((groups - 1) / groups)
    # In units of ``cov``, in which noise alone has a variance of 1 along every direction.
    root = square_root(cov)
    size, axes = np.linalg.eigh(root.T @ scaled_inverse(cov) @ spread.T @ spread @ scaled_inverse(cov) @ root)
    wider = root @ axes * np.sqrt(np.maximum(size - 1.0, 0.0))
    return np.asarray(cov + wider @ wider.T)
