"""Which distortion coefficients the data ask for: nested orders, each solved, and the one of lowest BIC chosen."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from udccal.fitting.geometry.bundle_noise import covariance, robust_scales, without_outliers
from udccal.fitting.geometry.bundle_points import Points
from udccal.fitting.geometry.bundle_solve import Bundle, Prior, Solved, residuals_px, solve
from udccal.fitting.geometry.bundle_start import best_poses, facing
from udccal.result import Candidate

# Distortion orders, simplest first: which of (k1, k2, p1, p2, k3) are free.
ORDERS = (
    ("no distortion", (0, 0, 0, 0, 0)),
    ("k1", (1, 0, 0, 0, 0)),
    ("k1 k2", (1, 1, 0, 0, 0)),
    ("k1 k2 p1 p2", (1, 1, 1, 1, 0)),
    ("k1 k2 p1 p2 k3", (1, 1, 1, 1, 1)),
)
INTRINSIC_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
# Ten to one against each further order before any data, as part of its BIC: a coefficient that is not there costs the
# others much of their certainty.
_AGAINST_FURTHER = 2 * np.log(10.0)
# Of the information on a focal length or the centre.
_PART_OF_PRIOR = 0.1
_SAME_COST = 1e-6
_MAX_SWAPS = 4
# A residual below this is arithmetic, not noise: orders that differ there only are equally good.
_ROUNDING_PX = 1e-7


@dataclass(frozen=True)
class Ordered:
    """The solution of the chosen order and the table of all; ``by_prior`` where the data could not choose."""

    solved: Solved
    free: Bool[np.ndarray, "9"]
    candidates: tuple[Candidate, ...]
    by_prior: bool


def free_intrinsics(order: tuple[int, ...]) -> Bool[np.ndarray, "9"]:
    """Focal lengths and centre are always fitted."""
    return np.array((1, 1, 1, 1, *order), dtype=bool)


def settle(starts: list[Bundle], points: Points, prior: Prior) -> tuple[Solved, Points, int]:
    """The best minimum with all distortions free that any start leads to, without outliers.

    Returns the minimum, the points with what was left out and the scatter of each view, and how many starts led there.
    """
    free = free_intrinsics(ORDERS[-1][1])
    found = [_settle_one(start, points, prior) for start in starts]
    best = min(found, key=lambda one: _score(one, points))
    scores = np.array([_score(one, points) for one in found])
    agree = int((scores <= scores.min() + _SAME_COST * max(abs(scores.min()), 1.0)).sum())
    solved, kept = _mirrored(*best, points, free, prior)
    return solved, kept, agree


def _score(found: tuple[Solved, Points], given: Points) -> float:
    """Robust spread of all points over the given sigma, comparable between starts that leave out different points."""
    length = np.linalg.norm(residuals_px(found[0].bundle, given), axis=1) / given.sigma
    return float(np.log1p(length**2).mean()) if np.isfinite(length).all() else np.inf


def _settle_one(start: Bundle, points: Points, prior: Prior) -> tuple[Solved, Points]:
    """Robustly and with few coefficients first: from far off, five bend the picture into any minimum."""
    bundle = start
    for order in (ORDERS[1], ORDERS[-1]):
        robust = points.scaled(robust_scales(bundle, points))
        bundle = solve(bundle, robust, free_intrinsics(order[1]), prior, robust=True).bundle
        bundle = replace(bundle, poses=facing(bundle.poses))
    return without_outliers(bundle, points, free_intrinsics(ORDERS[-1][1]), prior)


def _mirrored(
    solved: Solved, points: Points, given: Points, free: Bool[np.ndarray, "9"], prior: Prior
) -> tuple[Solved, Points]:
    """Views whose mirrored pose fits better take it, and all is solved again."""
    held = np.zeros(len(free), dtype=bool)
    for _ in range(_MAX_SWAPS):
        other = Bundle(solved.bundle.intrinsics, best_poses(points, solved.bundle.intrinsics)[1])
        other = solve(other, points, held, prior).bundle
        better = _view_costs(other, points) < 0.99 * _view_costs(solved.bundle, points)
        if not better.any():
            break
        poses = np.where(better[:, None], facing(other.poses), solved.bundle.poses)
        solved, points = without_outliers(Bundle(solved.bundle.intrinsics, poses), given, free, prior)
    return solved, points


def _view_costs(bundle: Bundle, points: Points) -> Float[np.ndarray, " views"]:
    square = (residuals_px(bundle, points) ** 2).sum(axis=1) / points.sigma**2
    square = np.where(np.isfinite(square), square, np.inf)
    return np.bincount(points.view[points.used], square[points.used], len(points.names))


def choose_order(full: Solved, points: Points, prior: Prior) -> Ordered:
    """Solve every order from the full one's quadratic model, and choose.

    Where the prior brings a good part of what is known of focal length or centre, the data are too few to tell a
    coefficient from a pose. All then stay free, each within its prior.
    """
    solutions, above = [full], free_intrinsics(ORDERS[-1][1])
    for _, order in ORDERS[-2::-1]:
        free = free_intrinsics(order)
        solutions.insert(0, solve(_constrained(solutions[0], above, free), points, free, prior))
        above = free
    scores = [
        Candidate(name, int(free_intrinsics(order).sum()) + 6 * len(points.names), _bic(one, points, order), False)
        for (name, order), one in zip(ORDERS, solutions, strict=True)
    ]
    known = np.diag(covariance(full, free_intrinsics(ORDERS[-1][1])))[:4] * prior.precision[:4]
    by_prior = bool((known > _PART_OF_PRIOR).any())
    best = len(scores) - 1 if by_prior else min(range(len(scores)), key=lambda k: scores[k].criterion)
    scores[best] = replace(scores[best], chosen=True)
    return Ordered(solutions[best], free_intrinsics(ORDERS[best][1]), tuple(scores), by_prior)


def _constrained(above: Solved, before: Bool[np.ndarray, "9"], free: Bool[np.ndarray, "9"]) -> Bundle:
    """Where the minimum moves when coefficients are held at 0, by the quadratic model of the order above."""
    x = np.concatenate([above.bundle.intrinsics, above.bundle.poses.ravel()])
    cov = covariance(above, before)
    drop = np.flatnonzero(before & ~free)
    moved = x - cov[:, drop] @ np.linalg.pinv(cov[np.ix_(drop, drop)], hermitian=True) @ x[drop]
    intrinsics = np.where(free, moved[: len(free)], 0.0)
    return Bundle(intrinsics, moved[len(free) :].reshape(-1, 6))


def _bic(solved: Solved, points: Points, order: tuple[int, ...]) -> float:
    """n log(chi2 / n) + k log n (Schwarz, 1978): the scale of the noise is estimated, too; and the odds before."""
    n = 2 * int(points.used.sum())
    square = (residuals_px(solved.bundle, points)[points.used] ** 2).sum(axis=1)
    variance = points.sigma[points.used] ** 2
    chi2 = max(float((square / variance).sum()), float((_ROUNDING_PX**2 / variance).sum()))
    place = next(k for k, (_, free) in enumerate(ORDERS) if free == order)
    parameters = sum(order) + 4 + 6 * len(points.names)
    return float(n * np.log(chi2 / n) + parameters * np.log(n) + place * _AGAINST_FURTHER)
