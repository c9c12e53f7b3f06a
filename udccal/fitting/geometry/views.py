"""Lens and poses from arrays of corners, of a ChArUco board through a panel and of a chessboard in a photograph alike.

The fit takes the robust minimum of the best start, without outliers. It then estimates the scatter by maximum
likelihood, and chooses the order of the distortion. The sigma of a point counts relative to that of others; its scale
is estimated. All views have one scale unless a test finds that they differ (by blur, light or distance).
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float

from udccal.errors import FitError
from udccal.fitting.engine.gaussian import Prior
from udccal.fitting.engine.misfit import SIGNIFICANT
from udccal.fitting.engine.orders import Attempt, Choice, bic, choose
from udccal.fitting.engine.robust import outliers, robust_sigma
from udccal.fitting.engine.tails import chi2_tail
from udccal.fitting.geometry.bundle import (
    EVERY,
    LENS,
    ORDERS,
    Bundle,
    GeometryRules,
    Intrinsics,
    Points,
    Solved,
    by_view,
    in_sigma,
    linearised,
    solve,
)
from udccal.fitting.geometry.calibrated import CalibratedViews, remarks, rms_px, status_of, weigh
from udccal.fitting.geometry.data import Gathered, best_poses, facing
from udccal.models.geometry import Geometry
from udccal.numerics import in_float64


@in_float64
def calibrate_views(
    gathered: Gathered,
    image_size: tuple[int, int],
    start: Geometry | None = None,
    prior: Prior | None = None,
    start_poses: Float[np.ndarray, "views 6"] | None = None,
    rules: GeometryRules | None = None,
) -> CalibratedViews:
    """Lens and poses with their covariance, and the evidence for them; ``fit_geometry`` makes the term of these.

    Args:
        gathered: the points, from ``gather``.
        image_size: (columns, rows).
        start, prior, rules: as for ``fit_geometry``.
        start_poses: per view, a pose to start from, with ``start``; see ``bundle.Bundle``.

    Raises:
        FitError: with fewer than 3 usable views (1 with a prior).
    """
    rules = rules or GeometryRules()
    least, known = (rules.least_views, Prior(np.zeros(LENS), np.zeros((0, LENS)))) if prior is None else (1, prior)
    given, left_out = gathered.points, gathered.outliers
    if len(given.names) < least:
        raise FitError(
            f"Expected at least {least} views of at least {rules.least_corners} points each, found {gathered.views} "
            f"views, {len(given.names)} of them usable. {' '.join(gathered.notes)} Capture more views of the board."
        )
    lens = None if start is None else Intrinsics.of_geometry(start)
    settled, marked = settle(given, image_size, lens, start_poses, known, rules)
    strange = _strange_views(marked, given, rules)
    if strange.any() and (~strange).sum() >= least:
        rule = f"of a view that scatters more than {rules.strange_view:g} times as much as the median view"
        left_out = (*left_out, *outliers(rule, (f"view {given.names[k]}" for k in np.flatnonzero(strange))))
        given = given.without(strange)
        settled, marked = settle(given, image_size, lens, start_poses, known, rules)
    full, points, scales = _maximum_likelihood(settled, marked, given, known)
    orders, by_prior = _choose_order(full, points, known, rules)
    free = ORDERS[orders.best.name]
    final, points, dof = _rescaled(orders.best.fit, points, free, known)
    evidence, cov = weigh(final, points, free, image_size, dof, rules)
    cov = cov if by_prior else cov + _between_orders(orders, 2 * int(points.used.sum()), rules)
    bundle = Bundle(final.place.intrinsics, facing(final.place.poses))
    residuals_px = linearised(bundle, points)[0]
    status, advice = status_of(final, cov, rms_px(residuals_px, points), image_size, rules)
    return CalibratedViews(
        intrinsics=Intrinsics.of(bundle.intrinsics),
        poses=bundle.poses,
        cov=cov,
        points=points,
        residuals_px=residuals_px,
        free=tuple(bool(one) for one in free),
        chi2_dof=float(((points.sigma / given.sigma)[points.used] ** 2).mean()) if gathered.weighted else 1.0,
        candidates=orders.candidates,
        evidence=evidence,
        status=status,
        notes=(*gathered.notes, *advice, *remarks(points, scales, evidence, by_prior, rules)),
        outliers=(*left_out, *rules.corners.listed(points.places(np.flatnonzero(~points.used)))),
        iterations=full.iterations,
        image_size=image_size,
    )


def starts(
    points: Points, size: tuple[int, int], given: Intrinsics | None, poses: Float[np.ndarray, "views 6"] | None
) -> list[Bundle]:
    """Starts: from the given intrinsics, and from the views' vanishing points or else a common lens."""
    centred = Intrinsics(np.full(2, _focal_px(points, size)), (np.array(size) - 1) / 2, np.zeros(5)).vector
    found = [Bundle(centred, best_poses(points, centred)[0])]
    if given is not None:
        found.insert(0, Bundle(given.vector, poses if poses is not None else best_poses(points, given.vector)[0]))
    return found


def _focal_px(points: Points, size: tuple[int, int]) -> float:
    """One focal length for both axes by the views' vanishing points; that of a common lens where they give none."""
    views = [points.view == k for k in range(len(points.names))]
    board = [(points.board[mine] * np.array([1.0, 1.0, 0.0])).astype(np.float32) for mine in views]
    image = [points.image[mine].astype(np.float32) for mine in views]
    usual = float(max(size))
    try:
        focal = float(cv2.initCameraMatrix2D(board, image, size, 1.0)[0, 0])
    except cv2.error:
        # Points of a size beyond single precision.
        return usual
    # The model does not describe lenses outside this range.
    return focal if 0.15 * usual <= focal <= 30.0 * usual else usual


def settle(
    given: Points,
    image_size: tuple[int, int],
    lens: Intrinsics | None,
    poses: Float[np.ndarray, "views 6"] | None,
    prior: Prior,
    rules: GeometryRules,
) -> tuple[Solved, Points]:
    """The best minimum of all starts with every distortion free, and the points with outliers marked.

    The points' sigma has each view's own scatter. Starts may leave out different points; the robust spread of all
    points compares them.
    """
    own = None if poses is None else np.asarray(poses, dtype=np.float64)[list(given.names)]
    found = [_descended(one, given, prior, rules) for one in starts(given, image_size, lens, own)]
    solved, points = min(found, key=lambda one: float(np.log1p(_squares(one[0].place, given)).mean()))
    for _ in range(8):  # Views whose mirrored pose fits better take it, and all is solved again.
        mirrored = Bundle(solved.place.intrinsics, best_poses(points, solved.place.intrinsics)[1])
        other = solve(mirrored, points, ~EVERY, prior).place
        better = costs(other, points) < 0.99 * costs(solved.place, points)
        if not better.any():
            break
        swapped = np.where(better[:, None], facing(other.poses), solved.place.poses)
        solved, points = _without_outliers(Bundle(solved.place.intrinsics, swapped), given, prior, rules)
    return solved, points


def _descended(start: Bundle, given: Points, prior: Prior, rules: GeometryRules) -> tuple[Solved, Points]:
    """Descend robustly and with few coefficients first: from far off, all five may lead to a wrong minimum."""
    bundle = start
    for free in (ORDERS["k1"], EVERY):
        bundle = solve(bundle, given.scaled(_robust_scales(bundle, given)), free, prior, rules.robust).place
        bundle = replace(bundle, poses=facing(bundle.poses))
    return _without_outliers(bundle, given, prior, rules)


def costs(bundle: Bundle, points: Points) -> Float[np.ndarray, " views"]:
    """Chi-squared of each view."""
    return points.sums(_squares(bundle, points))


def _squares(bundle: Bundle, points: Points) -> Float[np.ndarray, " points"]:
    """Squared residuals in units of sigma; infinite where a point's projection is not finite."""
    square = (linearised(bundle, points)[0] ** 2).sum(axis=1) / points.sigma**2
    return np.where(np.isfinite(square), square, np.inf)


def _robust_scales(bundle: Bundle, points: Points) -> Float[np.ndarray, " views"]:
    """Scatter over sigma of each view, from medians.

    The pose of a view with few points may fit them all: its scale is at least half of all views'.
    """
    z = np.where(points.used[:, None], linearised(bundle, points)[0] / points.sigma[:, None], np.nan)
    own = np.array([robust_sigma(z[points.view == k]) for k in range(len(points.names))])
    return np.maximum(np.maximum(own, 0.5 * robust_sigma(z)), least_scale(points))


def least_scale(points: Points) -> float:
    """The least factor on sigma: a sigma below 1e-8 px is rounding."""
    return 1e-8 / float(np.median(points.sigma))


def _without_outliers(start: Bundle, given: Points, prior: Prior, rules: GeometryRules) -> tuple[Solved, Points]:
    """Leave out points that are too far off and solve again, until nothing changes; points that fit again return."""
    scales = _robust_scales(start, given)
    points = _marked(start, given.scaled(scales), rules)
    solved = solve(start, points, EVERY, prior)
    for _ in range(8):
        before, used = scales, points.used
        scales = _robust_scales(solved.place, replace(given, used=used))
        points = _marked(solved.place, given.scaled(scales), rules)
        if (used == points.used).all() and np.allclose(scales, before, rtol=0.1):
            break
        solved = solve(solved.place, points, EVERY, prior)
    return solved, points


def _marked(bundle: Bundle, points: Points, rules: GeometryRules) -> Points:
    """Points with outliers marked as not used, except where too few would be left to determine a view's pose."""
    off = rules.corners.off(linearised(bundle, points)[0] / points.sigma[:, None]).any(axis=1)
    kept = np.bincount(points.view[~off], minlength=len(points.names))
    return replace(points, used=~off | (kept < rules.least_corners)[points.view])


def _strange_views(scattered: Points, given: Points, rules: GeometryRules) -> Bool[np.ndarray, " views"]:
    """Views to leave out: their points are in another order, the board is another one, or it moved."""
    ratio = np.array([np.median((scattered.sigma / given.sigma)[given.view == k]) for k in range(len(given.names))])
    return np.asarray(ratio > rules.strange_view * np.median(ratio))


def _maximum_likelihood(
    solved: Solved, points: Points, given: Points, prior: Prior
) -> tuple[Solved, Points, Float[np.ndarray, " views"]]:
    """Scales by residuals and their degrees of freedom, points with scaled sigma, and the solution with these."""
    given, scales = replace(given, used=points.used), np.ones(len(given.names))
    for _ in range(8):
        square, dof = costs(solved.place, given), 2 * given.sums(np.ones(len(given.view))) - _spent(solved, points)
        differ = _differ(square, dof)
        own = square / np.maximum(dof, 1.0) if differ else np.full(len(dof), square.sum() / max(dof.sum(), 1.0))
        before, scales = scales, np.maximum(np.sqrt(own), least_scale(given))
        points = given.scaled(scales)
        solved = solve(solved.place, points, EVERY, prior)
        if not differ or np.allclose(scales, before, rtol=1e-3):
            break
    return solved, points, scales


def _spent(solved: Solved, points: Points) -> Float[np.ndarray, " views"]:
    """Degrees of freedom that the fit uses of each view: the trace of information times covariance."""
    information, _ = by_view(*in_sigma(solved.place, points), points)
    views = np.arange(len(points.names))[:, None]
    mine = np.hstack([np.arange(LENS) + 0 * views, LENS + 6 * views + np.arange(6)])
    cov = solved.equations.joint_cov()[mine[:, :, None], mine[:, None, :]]
    return np.einsum("kij,kji->k", information, cov)


def _differ(square: Float[np.ndarray, " views"], dof: Float[np.ndarray, " views"]) -> bool:
    """Bartlett's test of equal variances (1937), over views with at least four degrees of freedom."""
    if len(dof) < 2 or not ((dof >= 4) & (square > 0)).all():
        return False
    ratio = float((dof * np.log(square.sum() / dof.sum() / (square / dof))).sum())
    correction = 1 + ((1 / dof).sum() - 1 / dof.sum()) / (3 * (len(dof) - 1))
    return chi2_tail(ratio / correction, len(dof) - 1) < SIGNIFICANT


def _choose_order(full: Solved, points: Points, prior: Prior, rules: GeometryRules) -> tuple[Choice[Solved], bool]:
    """Every order, each solved from the one above with its further coefficients at 0; and whether the prior chose.

    Where a large part of the information on focal length or centre is the prior's, the data are too few to separate a
    coefficient from a pose. All coefficients then stay free, each within its prior.
    """
    tried: list[Attempt[Solved]] = []
    solved = full
    for place, (name, free) in reversed(list(enumerate(ORDERS.items()))):
        if tried:
            above = Bundle(np.where(free, solved.place.intrinsics, 0.0), solved.place.poses)
            solved = solve(above, points, free, prior)
        parameters = int(free.sum()) + 6 * len(points.names)
        criterion = _criterion(solved, points, parameters) + 2 * place * np.log(rules.further_order)
        tried.insert(0, Attempt(name, parameters, float(criterion), solved))
    known = Intrinsics.of(np.diag(full.equations.cov()) * np.diag(prior.precision))
    by_prior = bool(max(*known.focal_px, *known.principal_point_px) > rules.prior_share)
    return (Choice(tried[-1], tuple(tried)) if by_prior else choose(tried)), by_prior


def _between_orders(orders: Choice[Solved], samples: int, rules: GeometryRules) -> Float[np.ndarray, "n n"]:
    """Covariance that the choice of an order adds to that of all values."""
    further = 2 * np.log(rules.further_order) * np.arange(len(orders.tried))
    return orders.spread(samples, lambda of: np.concatenate([of.place.intrinsics, of.place.poses.ravel()]), further)


def _criterion(solved: Solved, points: Points, parameters: int) -> float:
    """BIC with an estimated scale of the noise: n ln(chi2 / n) replaces chi2.

    A residual below 1e-7 px is rounding, not noise: orders that differ only there are equally good.
    """
    samples = 2 * int(points.used.sum())
    chi2 = float(costs(solved.place, points).sum())
    least = float((1e-7**2 / points.sigma[points.used] ** 2).sum())
    return bic(samples * float(np.log(max(chi2, least) / samples)), float(parameters), samples)


def _rescaled(
    solved: Solved, points: Points, free: Bool[np.ndarray, "9"], prior: Prior
) -> tuple[Solved, Points, float]:
    """The chosen order with the scale of its own residuals, and the degrees of freedom of that scale."""
    dof = max(2 * float(points.used.sum()) - float(_spent(solved, points).sum()), 1.0)
    factor = max(np.sqrt(float(costs(solved.place, points).sum()) / dof), least_scale(points))
    points = points.scaled(np.full(len(points.names), factor))
    return solve(solved.place, points, free, prior), points, dof
