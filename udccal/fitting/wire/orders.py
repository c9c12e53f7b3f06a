"""Which columns of a linear problem the data support, by the Bayesian information criterion: backward, then forward."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Bool, Float, Int

from udccal.fitting.engine.orders import Attempt, Choice, bic, choose

# Of a dropped column, the part that the kept ones cannot say; less is rounding.
_LEAST_NEW = 1e-8


@final
@dataclass(frozen=True)
class Kept:
    """Columns that are kept, the solution with them alone, and its covariance."""

    keep: Bool[np.ndarray, " all"]
    values: Float[np.ndarray, " all"]
    inverse: Float[np.ndarray, "kept kept"]


@final
@dataclass(frozen=True)
class _Columns:
    """A linear least-squares problem whose columns are kept or dropped by groups; -1 is always kept."""

    matrix: Float[np.ndarray, "all all"]
    right: Float[np.ndarray, " all"]
    power: float
    samples: int
    groups: Int[np.ndarray, " all"]

    def solved(self, keep: Bool[np.ndarray, " all"]) -> Kept:
        """With these alone."""
        part = self.matrix[np.ix_(keep, keep)]
        scale = np.sqrt(np.maximum(np.diag(part), 1e-300))
        # The tiny ridge only decides between columns that the data cannot tell apart.
        inverse = np.linalg.inv(part / np.outer(scale, scale) + 1e-10 * np.eye(len(scale))) / np.outer(scale, scale)
        values = np.zeros(len(keep))
        values[keep] = inverse @ self.right[keep]
        return Kept(keep, values, inverse)

    def attempt(self, fit: Kept, variance: float, note: str = "") -> Attempt[Kept]:
        """By the Bayesian information criterion, chi-squared in units of ``variance``."""
        count, terms = int(fit.keep.sum()), (len(np.unique(g[g >= 0])) for g in (self.groups[fit.keep], self.groups))
        chi2 = (self.power - float(self.right @ fit.values)) / variance
        return Attempt("{} of {} terms".format(*terms) + note, count, bic(chi2, float(count), self.samples), fit)

    def weak(self, fit: Kept, variance: float) -> list[int]:
        """Groups that do not pay for themselves, the weakest by column first."""
        kept, found = self.groups[fit.keep], []
        for group in np.unique(kept[kept >= 0]):
            inside = kept == group
            v = fit.values[fit.keep][inside]
            # Exact rise of chi-squared when this group alone is left out.
            rise = float(v @ np.linalg.solve(fit.inverse[np.ix_(inside, inside)], v)) / variance
            found.append((rise / len(v), int(group)))
        return [group for rise, group in sorted(found) if rise < np.log(self.samples)]

    def missed(self, fit: Kept, variance: float) -> int | None:
        """The dropped group whose return would lower the criterion most; rounds of many groups may drop too much."""
        left, found, best = self.right - self.matrix @ fit.values, None, 0.0
        for group in np.unique(self.groups[~fit.keep]):
            inside = self.groups == group
            cross = self.matrix[np.ix_(inside, fit.keep)]
            own = self.matrix[np.ix_(inside, inside)] - cross @ fit.inverse @ cross.T
            scale = np.sqrt(np.maximum(np.diag(self.matrix)[inside], 1e-300))
            eigen, vectors = np.linalg.eigh(own / np.outer(scale, scale))
            new = eigen > _LEAST_NEW
            gain = float(np.sum((vectors.T @ (left[inside] / scale))[new] ** 2 / eigen[new])) / variance
            if gain - inside.sum() * np.log(self.samples) > best:
                found, best = int(group), gain - inside.sum() * np.log(self.samples)
        return found


def select(
    matrix: Float[np.ndarray, "all all"],
    right: Float[np.ndarray, " all"],
    power: float,
    samples: int,
    groups: Int[np.ndarray, " all"],
) -> Choice[Kept]:
    """Drop groups of columns while that lowers the criterion, and take back what was dropped in error; -1 stays.

    A group of k columns pays for itself when leaving it out raises chi-squared, in units of the residual variance of
    the full model (so that PRNU counts as noise), by more than k ln(samples). In each round the weaker half of the
    groups that do not goes; the rest is judged again.

    Args:
        matrix, right: normal equations of all columns.
        power: weighted sum of the squared data.
        samples: how many.
        groups: of the columns.
    """
    columns = _Columns(matrix, right, power, samples, groups)
    fit = columns.solved(np.ones(len(right), dtype=bool))
    variance = max((power - float(right @ fit.values)) / max(samples - len(right), 1), 1e-300)
    tried = [columns.attempt(fit, variance)]
    while weak := columns.weak(fit, variance):
        fit = columns.solved(fit.keep & ~np.isin(groups, weak[: -(-len(weak) // 2)]))
        tried.append(columns.attempt(fit, variance))
    fit = choose(tried).best.fit
    while (missed := columns.missed(fit, variance)) is not None:
        fit = columns.solved(fit.keep | (groups == missed))
        tried.append(columns.attempt(fit, variance, ", one taken back"))
    return choose(tried)
