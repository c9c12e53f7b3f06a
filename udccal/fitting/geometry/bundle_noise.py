"""How far a bundle's points scatter: robustly, to find outliers, then by likelihood, for the weights and the sigma.

The sigma that comes with a point tells how it compares with others; its scale is estimated. One scale serves all views
unless a test says that the views differ (blur, light and distance do that): then each has its own.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from udccal.fitting.engine.tails import chi2_tail
from udccal.fitting.geometry.bundle_normal import INTRINSICS
from udccal.fitting.geometry.bundle_points import MIN_POINTS, Points
from udccal.fitting.geometry.bundle_solve import Bundle, Prior, Solved, linearised, residuals_px, solve

# Points further from the model than this many robust sigma of their view are left out, then all is refit.
OUTLIER_SIGMA = 5.0
OUTLIER_RULE = f"further than {OUTLIER_SIGMA:g} robust sigma of its view from the model"
# A view that scatters this many times as much as the median view does not show what was said of it.
STRANGE_VIEW = 20.0
STRANGE_RULE = f"of a view that scatters more than {STRANGE_VIEW:g} times as much as the median view"
_MAX_ROUNDS = 8
_SETTLED_SCALE = 0.1
# The length of a two-dimensional normal deviate has this median.
_MEDIAN = 1.1774100225154747
# A view of few points may fit them all by its pose: its robust sigma is not taken below this part of all views'.
_LEAST_OF_ALL = 0.5
# Below this, residuals are rounding: exact points must not count as surer than arithmetic.
_LEAST_SIGMA_PX = 1e-8
# Views differ in their scatter where equal ones would look so unequal this rarely (Bartlett, 1937).
_DIFFER_P = 1e-3
_SCALE_ROUNDS = 4


@dataclass(frozen=True)
class Scatter:
    """Points with the sigma that their scatter has, and what that was against the sigma given.

    ``scales`` is per view; they are all the same unless ``per_view``.
    """

    points: Points
    scales: Float[np.ndarray, " views"]
    per_view: bool


def robust_scales(bundle: Bundle, points: Points) -> Float[np.ndarray, " views"]:
    """Scatter over sigma of each view, from medians."""
    length = np.linalg.norm(residuals_px(bundle, points), axis=1) / points.sigma
    own = np.array([_median(length[(points.view == k) & points.used]) for k in range(len(points.names))])
    every = _median(length[points.used])
    return np.maximum(np.maximum(own, _LEAST_OF_ALL * every), least_scale(points))


def least_scale(points: Points) -> float:
    """The least by which the sigma of points may be scaled."""
    return _LEAST_SIGMA_PX / float(np.median(points.sigma))


def _median(length: np.ndarray) -> float:
    return float(np.median(length)) / _MEDIAN if len(length) else 0.0


def without_outliers(start: Bundle, given: Points, free: Bool[np.ndarray, "9"], prior: Prior) -> tuple[Solved, Points]:
    """Leave out what is too far off and solve again, until nothing changes; what fits again comes back.

    ``given`` has the sigma as given; the points that come back have each view's own scatter, as their weights need it.
    """
    scales = robust_scales(start, given)
    points = given.scaled(scales)
    points = replace(points, used=_near(start, points))
    solved = solve(start, points, free, prior)
    for _ in range(_MAX_ROUNDS):
        before, scales = scales, robust_scales(solved.bundle, replace(given, used=points.used))
        rescaled = given.scaled(scales)
        used = _near(solved.bundle, rescaled)
        settled = bool((used == points.used).all()) and np.allclose(scales, before, rtol=_SETTLED_SCALE)
        points = replace(rescaled, used=used)
        if settled:
            break
        solved = solve(solved.bundle, points, free, prior)
    return solved, points


def strange_views(scattered: Points, given: Points) -> Bool[np.ndarray, " views"]:
    """Views that are better left out: read in another order, another board, moved while captured."""
    ratio = np.array([np.median((scattered.sigma / given.sigma)[given.view == k]) for k in range(len(given.names))])
    return np.asarray(ratio > STRANGE_VIEW * np.median(ratio))


def _near(bundle: Bundle, points: Points) -> Bool[np.ndarray, " points"]:
    near = np.linalg.norm(residuals_px(bundle, points), axis=1) <= OUTLIER_SIGMA * points.sigma
    # What is left of a view must still hold its pose.
    kept = np.bincount(points.view[near], minlength=len(points.names))
    return near | (kept < MIN_POINTS)[points.view]


def covariance(solved: Solved, free: Bool[np.ndarray, "9"]) -> Float[np.ndarray, "n n"]:
    """Inverse information on intrinsics and poses, with zeros for intrinsics that are held.

    By blocks, as the solver eliminates them. Directions that the data do not tell get the largest variance that the
    arithmetic holds, not infinity.
    """
    own = _inverse(solved.own, np.einsum("kii->ki", solved.own))
    carried = own @ np.swapaxes(solved.mixed, 1, 2)
    # In units of what would be known if the poses were: what is left of that after them may be nothing but rounding.
    reduced = solved.common - (solved.mixed @ carried).sum(axis=0)
    lens = _inverse(reduced[None], np.diag(solved.common)[None])[0]
    lens = np.where(np.outer(free, free), lens, 0.0)
    carried = carried.reshape(-1, INTRINSICS)
    size = INTRINSICS + len(carried)
    cov = np.empty((size, size))
    cov[:INTRINSICS, :INTRINSICS] = lens
    cov[INTRINSICS:, :INTRINSICS] = -carried @ lens
    cov[:INTRINSICS, INTRINSICS:] = cov[INTRINSICS:, :INTRINSICS].T
    cov[INTRINSICS:, INTRINSICS:] = carried @ lens @ carried.T
    for view, block in enumerate(own):
        mine = slice(INTRINSICS + 6 * view, INTRINSICS + 6 * view + 6)
        cov[mine, mine] += block
    return cov


def _inverse(matrices: Float[np.ndarray, "k n n"], size: Float[np.ndarray, "k n"]) -> Float[np.ndarray, "k n n"]:
    """Inverses of positive matrices, brought to the size 1 first; eigenvalues below rounding are raised to it."""
    unit = 1 / np.sqrt(np.maximum(size, 1e-100))
    outer = unit[:, :, None] * unit[:, None, :]
    values, vectors = np.linalg.eigh(matrices * outer)
    values = np.maximum(values, 1e-14 * np.maximum(values[:, -1:], 1e-14))
    return (vectors / values[:, None, :]) @ np.swapaxes(vectors, 1, 2) * outer


def maximum_likelihood(
    solved: Solved, points: Points, given: Points, free: Bool[np.ndarray, "9"], prior: Prior
) -> tuple[Solved, Scatter]:
    """Scales from residuals and their degrees of freedom, and the solution weighted by them.

    Args:
        solved: next to the solution.
        points: as ``solved`` weighs them.
        given: with the sigma as given; ``points.used`` counts.
        free: which intrinsics are fitted.
        prior: on the intrinsics.
    """
    given = replace(given, used=points.used)
    scales, per_view = np.ones(len(given.names)), False
    for _ in range(_SCALE_ROUNDS):
        square, dof = _squares(solved, points, given, free)
        common = np.sqrt(square.sum() / max(dof.sum(), 1.0))
        per_view = _differ(square, dof)
        own = np.sqrt(square / np.maximum(dof, 1.0)) if per_view else np.full(len(dof), common)
        settled = np.allclose(own, scales, rtol=1e-3)
        scales = np.maximum(own, least_scale(given))
        points = given.scaled(scales)
        solved = solve(solved.bundle, points, free, prior)
        if settled or not per_view:
            break
    return solved, Scatter(points, scales, per_view)


def _squares(
    solved: Solved, points: Points, given: Points, free: Bool[np.ndarray, "9"]
) -> tuple[Float[np.ndarray, " views"], Float[np.ndarray, " views"]]:
    """Sum of squares over the given sigma, and degrees of freedom, of each view."""
    length = np.linalg.norm(residuals_px(solved.bundle, points), axis=1) / given.sigma
    views, use = len(points.names), points.used
    dof = 2 - leverages(solved, points, free)
    return np.bincount(points.view[use], length[use] ** 2, views), np.bincount(points.view[use], dof[use], views)


def leverages(solved: Solved, points: Points, free: Bool[np.ndarray, "9"]) -> Float[np.ndarray, " points"]:
    """Degrees of freedom, of two, that the fit spends on each point."""
    _, slopes = linearised(solved.bundle, points)
    cov, views = covariance(solved, free), len(points.names)
    picks = [np.r_[:INTRINSICS, INTRINSICS + 6 * view : INTRINSICS + 6 * view + 6] for view in range(views)]
    blocks = np.array([cov[np.ix_(pick, pick)] for pick in picks])[points.view]
    return ((slopes @ blocks) * slopes).sum(axis=(1, 2)) / points.sigma**2


def _differ(square: Float[np.ndarray, " views"], dof: Float[np.ndarray, " views"]) -> bool:
    """Bartlett's test of equal variances, over views that have at least four degrees of freedom."""
    enough = (dof >= 4) & (square > 0)
    if enough.sum() < 2 or not enough.all():
        return False
    mean = square.sum() / dof.sum()
    ratio = float((dof * np.log(mean / (square / dof))).sum())
    views = len(dof)
    correction = 1 + ((1 / dof).sum() - 1 / dof.sum()) / (3 * (views - 1))
    return chi2_tail(ratio / correction, views - 1) < _DIFFER_P
