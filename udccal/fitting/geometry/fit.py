"""Lens and poses from arrays of corners, of a ChArUco board through a panel and of a chessboard in a photograph alike.

The fit takes the robust minimum of the best start, without outliers. It then estimates the scatter by maximum
likelihood, and chooses the order of the distortion. The sigma of a point counts relative to that of others; its scale
is estimated. All views have one scale unless a test finds that they differ (by blur, light or distance).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from udccal.errors import FitError
from udccal.fitting.engine.gaussian import Prior
from udccal.fitting.engine.misfit import SIGNIFICANT
from udccal.fitting.engine.orders import Attempt, Choice, bic, choose
from udccal.fitting.engine.robust import outliers
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
from udccal.fitting.geometry.calibrated import CalibratedViews, Evidence, weigh
from udccal.fitting.geometry.start import costs, facing, gather, least_scale, settle
from udccal.models.geometry import Geometry
from udccal.numerics import in_float64
from udccal.result import FitStatus


@in_float64
def fit_geometry(
    board_points: Sequence[Float[np.ndarray, "..."]],
    image_points: Sequence[Float[np.ndarray, "..."]],
    image_size: tuple[int, int],
    start: Geometry | None = None,
    sigmas: Sequence[Float[np.ndarray, " _"]] | None = None,
    *,
    prior: Prior | None = None,
    start_poses: Float[np.ndarray, "views 6"] | None = None,
    rules: GeometryRules | None = None,
) -> CalibratedViews:
    """Calibrate a camera from views of flat boards.

    Args:
        board_points: per view, points on the board (z = 0) in any unit of length, (n, 3) or (n, 1, 3).
        image_points: per view, the same points in px, (n, 2) or (n, 1, 2) as OpenCV gives them. (0, 0) is the centre of
            the top-left pixel; NaN where not seen.
        image_size: (columns, rows).
        start: intrinsics to start from. The views' vanishing points (Zhang, 2000) give another start in any case; the
            lower minimum wins.
        sigmas: per view, one sigma in px of each point, up to a common factor; without it all points count alike.
        prior: on the intrinsics, in the order of ``Intrinsics``; with it a single view may be enough.
        start_poses: per view, a pose to start from, with ``start``.
        rules: see ``GeometryRules``.

    Returns:
        lens and poses with their covariance, and the evidence for them. The order of the distortion is the one with the
        lowest BIC (Schwarz, 1978) on the points that remain after outliers are left out.

    Raises:
        FitError: with fewer than 3 usable views (1 with a prior), each of 6 finite points that are not on one line; or
            when the arrays do not belong together.
    """
    rules = rules or GeometryRules()
    gathered = gather(board_points, image_points, sigmas, rules)
    least, known = (rules.least_views, Prior(np.zeros(LENS), np.zeros((0, LENS)))) if prior is None else (1, prior)
    given, left_out = gathered.points, gathered.outliers
    if len(given.names) < least:
        raise FitError(
            f"Expected at least {least} views of at least {rules.least_corners} points each, found {len(board_points)} "
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
    status, advice = _status(final, cov, image_size, rules)
    bundle = Bundle(final.place.intrinsics, facing(final.place.poses))
    return CalibratedViews(
        intrinsics=Intrinsics.of(bundle.intrinsics),
        poses=bundle.poses,
        cov=cov,
        points=points,
        residuals_px=linearised(bundle, points)[0],
        free=tuple(bool(one) for one in free),
        chi2_dof=1.0 if sigmas is None else float(((points.sigma / given.sigma)[points.used] ** 2).mean()),
        candidates=orders.candidates,
        evidence=evidence,
        status=status,
        notes=(*gathered.notes, *advice, *_remarks(points, scales, evidence, by_prior, rules)),
        outliers=(*left_out, *rules.corners.listed(points.places(np.flatnonzero(~points.used)))),
        iterations=full.iterations,
        image_size=image_size,
    )


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


def _status(
    solved: Solved, cov: Float[np.ndarray, "n n"], image_size: tuple[int, int], rules: GeometryRules
) -> tuple[FitStatus, tuple[str, ...]]:
    """Whether the views determine the lens; else what to capture."""
    sigma, lens = Intrinsics.of(np.sqrt(np.diag(cov))), Intrinsics.of(solved.place.intrinsics)
    by_focal = float(np.max(sigma.focal_px / np.abs(lens.focal_px)))
    by_centre = float(np.max(sigma.principal_point_px)) / image_size[0]
    if max(by_focal, by_centre) > rules.most_uncertain:
        what = "focal length" if by_focal > by_centre else "centre of the picture"
        return FitStatus.TOO_FEW_DATA, (
            f"The views do not determine the {what} (one sigma is {min(max(by_focal, by_centre), 99.0):.0%}). "
            "Lean the board by 20 to 40 degrees, another way in each view, and let it fill the picture.",
        )
    if not solved.converged:
        return FitStatus.NOT_CONVERGED, ("Check that the points of each view are in the order of the board's.",)
    return FitStatus.CONVERGED, ()


def _remarks(
    points: Points, scales: Float[np.ndarray, " views"], evidence: Evidence, by_prior: bool, rules: GeometryRules
) -> Iterator[str]:
    if by_prior:
        yield (
            "The views alone do not determine the whole lens: what is known beforehand gives part of it, and every "
            "distortion coefficient stays free within that. Lean the board another way in each view to know more."
        )
    relative = scales / np.median(scales)
    loud = [f"{points.names[k]} ({relative[k]:.1f} x)" for k in np.flatnonzero(relative > rules.loud_view)]
    if loud:
        yield f"Views that scatter more than the median view, and count for less: {', '.join(loud)}."
    yield from evidence.notes
