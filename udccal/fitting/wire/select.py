"""Which harmonics and degrees the data support, by the Bayesian information criterion: backward, then forward."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from udccal.result import Candidate

_ROUNDS = 24
# In each round the weaker half of the groups that do not pay for themselves goes; the rest is judged again.
_SHARE = 0.5
# Of a dropped column, the share that the kept ones cannot say; less is rounding.
_LEAST_NEW = 1e-8


@dataclass(frozen=True)
class Selection:
    """The chosen columns with their values, and the residual variance in units of the one expected."""

    keep: Bool[np.ndarray, " all"]
    values: Float[np.ndarray, " all"]
    variance: float
    candidates: tuple[Candidate, ...]


def select(
    matrix: Float[np.ndarray, "all all"],
    right: Float[np.ndarray, " all"],
    power: float,
    samples: int,
    groups: Int[np.ndarray, " all"],
) -> Selection:
    """Drop groups of columns while that lowers the criterion, and take back what was dropped in error; -1 stays.

    A group of k columns pays for itself when leaving it out raises chi-squared, in units of the residual variance of
    the full model (so that PRNU counts as noise), by more than k ln(samples).
    """
    keep = np.ones(len(right), dtype=bool)
    values, inverse = _solve(matrix, right, keep)
    variance = max((power - right @ values) / max(samples - keep.sum(), 1), 1e-300)
    tried = [(keep.copy(), values, _criterion(power, right, values, keep, variance, samples))]
    for _ in range(_ROUNDS):
        weak = _weak_groups(groups, keep, values, inverse, variance, samples)
        if not weak:
            break
        for group in weak[: max(1, int(np.ceil(len(weak) * _SHARE)))]:
            keep &= groups != group
        values, inverse = _solve(matrix, right, keep)
        tried.append((keep.copy(), values, _criterion(power, right, values, keep, variance, samples)))
    eliminated = len(tried)
    keep = tried[int(np.argmin([criterion for _, _, criterion in tried]))][0].copy()
    for _ in range(_ROUNDS):
        missed = _missed_group(matrix, right, groups, keep, variance, samples)
        if missed is None:
            break
        keep |= groups == missed
        values, inverse = _solve(matrix, right, keep)
        tried.append((keep.copy(), values, _criterion(power, right, values, keep, variance, samples)))
    best = int(np.argmin([criterion for _, _, criterion in tried]))
    candidates = tuple(
        Candidate(
            f"{_terms(groups, kept)} of {_terms(groups)} terms{', one taken back' if i >= eliminated else ''}",
            int(kept.sum()),
            float(criterion),
            i == best,
        )
        for i, (kept, _, criterion) in enumerate(tried)
    )
    keep, values, _ = tried[best]
    final = max((power - right @ values) / max(samples - keep.sum(), 1), 1e-300)
    return Selection(keep, values, float(final), candidates)


def _terms(groups: Int[np.ndarray, " all"], kept: Bool[np.ndarray, " all"] | None = None) -> int:
    """How many groups there are that may go, or how many of them are kept."""
    mine = groups if kept is None else groups[kept]
    return len(np.unique(mine[mine >= 0]))


def _solve(
    matrix: Float[np.ndarray, "all all"], right: Float[np.ndarray, " all"], keep: Bool[np.ndarray, " all"]
) -> tuple[Float[np.ndarray, " all"], Float[np.ndarray, "kept kept"]]:
    part = matrix[np.ix_(keep, keep)]
    scale = np.sqrt(np.maximum(np.diag(part), 1e-300))
    # The tiny ridge only decides between columns that the data cannot tell apart.
    normal = part / np.outer(scale, scale) + 1e-10 * np.eye(len(scale))
    inverse = np.linalg.inv(normal) / np.outer(scale, scale)
    values = np.zeros(len(right))
    values[keep] = inverse @ right[keep]
    return values, inverse


def _criterion(
    power: float,
    right: Float[np.ndarray, " all"],
    values: Float[np.ndarray, " all"],
    keep: Bool[np.ndarray, " all"],
    variance: float,
    samples: int,
) -> float:
    return float((power - right @ values) / variance + keep.sum() * np.log(samples))


def _weak_groups(
    groups: Int[np.ndarray, " all"],
    keep: Bool[np.ndarray, " all"],
    values: Float[np.ndarray, " all"],
    inverse: Float[np.ndarray, "kept kept"],
    variance: float,
    samples: int,
) -> list[int]:
    kept = np.flatnonzero(keep)
    weak = []
    for group in np.unique(groups[keep]):
        if group < 0:
            continue
        inside = np.flatnonzero(groups[kept] == group)
        v = values[kept[inside]]
        # Exact rise of chi-squared when this group alone is left out.
        rise = float(v @ np.linalg.solve(inverse[np.ix_(inside, inside)], v)) / variance
        margin = rise - len(inside) * np.log(samples)
        if margin < 0:
            weak.append((margin / len(inside), int(group)))
    return [group for _, group in sorted(weak)]


def _missed_group(
    matrix: Float[np.ndarray, "all all"],
    right: Float[np.ndarray, " all"],
    groups: Int[np.ndarray, " all"],
    keep: Bool[np.ndarray, " all"],
    variance: float,
    samples: int,
) -> int | None:
    """The dropped group whose return would lower the criterion most; rounds of many groups may drop too much."""
    values, inverse = _solve(matrix, right, keep)
    left = right - matrix @ values
    found, best = None, 0.0
    for group in np.unique(groups[~keep]):
        inside = groups == group
        shared = matrix[np.ix_(inside, keep)]
        own = matrix[np.ix_(inside, inside)] - shared @ inverse @ shared.T
        scale = np.sqrt(np.maximum(np.diag(matrix)[inside], 1e-300))
        eigen, vectors = np.linalg.eigh(own / np.outer(scale, scale))
        seen = eigen > _LEAST_NEW
        gain = float(np.sum((vectors.T @ (left[inside] / scale))[seen] ** 2 / eigen[seen])) / variance
        margin = gain - inside.sum() * np.log(samples)
        if margin > best:
            found, best = int(group), margin
    return found
