"""Lens and poses from arrays of corners, of a ChArUco board through a panel and of a chessboard in a photograph alike.

The fit takes the robust minimum of the best start, without outliers. It then estimates the scatter by maximum
likelihood, and chooses the order of the distortion. The sigma of a point counts relative to that of others; its scale
is estimated. All views have one scale unless a test finds that they differ (by blur, light or distance).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import combinations
from typing import final

import cv2
import numpy as np
from jaxtyping import Bool, Float

from udccal.errors import FitError
from udccal.fitting.engine.gaussian import Prior
from udccal.fitting.engine.misfit import chi2_test
from udccal.fitting.engine.orders import Attempt, Choice, bic, choose
from udccal.fitting.engine.robust import Cauchy, outliers, robust_sigma
from udccal.fitting.geometry.board_points import BoardPoints, board_points
from udccal.fitting.geometry.board_shape import BoardShape, board_shape
from udccal.fitting.geometry.bundle import (
    EVERY,
    NOTHING_KNOWN,
    ORDERS,
    Bundle,
    BundleProblem,
    Free,
    Intrinsics,
    Points,
    Poses,
    Solved,
    linearised,
    solve,
)
from udccal.fitting.geometry.calibrated import CalibratedViews, disagreement, judged, residual_pattern
from udccal.fitting.geometry.data import Gathered, best_poses
from udccal.models.geometry import Geometry
from udccal.numerics import in_float64
from udccal.result import FitStatus, Outliers

# A detector finds corners up to so far beyond the centres of the outermost pixels.
_BESIDE_PX = 1.0
# So many corners beyond that, or such a part of all, may be outliers.
_FEW_BESIDE, _PART_BESIDE = 3, 0.01


@in_float64
def calibrate_views(
    gathered: Gathered,
    image_size: tuple[int, int],
    start: Geometry | None = None,
    prior: Prior | None = None,
    start_poses: Poses | None = None,
) -> CalibratedViews:
    """Lens and poses with their covariance, and tests of them; ``fit_geometry`` makes the term of these.

    Args:
        gathered: the points, from ``gather``.
        image_size: (columns, rows).
        start, prior: as for ``fit_geometry``.
        start_poses: per view, a pose to start from, with ``start``; see ``bundle.Bundle``.

    Raises:
        FitError: with fewer than 3 usable views (1 with a prior).
    """
    check_picture(image_size, gathered.points)
    given, rules = gathered.points, gathered.points.rules
    least, known = (rules.least_views, NOTHING_KNOWN) if prior is None else (1, prior)
    if len(given.names) < least:
        found = f"{len(given.names) + len(gathered.notes)} views, {len(given.names)} of them usable"
        raise FitError(
            f"Expected at least {least} views of at least {rules.least_corners} points each, found {found}. "
            + " ".join([*gathered.notes, "Capture more views of the board."])
        )
    robust, given, strange = _distinct(
        given, least, lambda points: _Search(points, known).best_of(starts(points, image_size, start, start_poses))
    )
    given = replace(given, used=robust.points.used)
    likely, boards = _of_the_board(_scaled(robust, given, EVERY, known), given, known)
    orders, between = _choose_order(likely, known)
    free = ORDERS[orders.best.name]
    final = _scaled(replace(likely, solved=orders.best.fit), likely.points, free, known)
    points, solved, bundle = final.points, final.solved, final.solved.place.facing()
    disagree, cov = disagreement(solved, points, free, final.dof)
    for board in boards:
        cov = cov + board.added_cov(solved, points, free)
    pattern, pattern_px = residual_pattern(solved, points, image_size, final.dof)
    places = (f"view {points.names[points.view[k]]}, point {points.index[k]}" for k in np.flatnonzero(~points.used))
    views = CalibratedViews(
        intrinsics=Intrinsics.of(bundle.intrinsics),
        poses=bundle.poses,
        cov=cov if between is None else cov + between,
        points=points,
        residuals_px=linearised(bundle, points)[0],
        free=tuple(free.tolist()),
        chi2_dof=float(((points.sigma / given.sigma)[points.used] ** 2).mean()) if gathered.weighted else 1.0,
        candidates=orders.candidates,
        disagreement=disagree,
        pattern=pattern,
        pattern_px=pattern_px,
        status=FitStatus.CONVERGED if solved.converged else FitStatus.NOT_CONVERGED,
        notes=(*gathered.notes, *(sentence for board in boards for sentence in board.told())),
        outliers=(*gathered.outliers, *strange, *rules.corners.listed(places)),
        iterations=likely.solved.iterations,
        image_size=image_size,
    )
    return judged(views, likely.scales, between is None)


def starts(points: Points, size: tuple[int, int], given: Geometry | None, poses: Poses | None) -> list[Bundle]:
    """Starts: from the given intrinsics, and from the views' vanishing points or else a common lens."""
    lenses = [] if given is None else [Intrinsics.of_geometry(given).vector]
    lenses.append(Intrinsics.centred(_focal_px(points, size), size).vector)
    found = [Bundle(lens, best_poses(points, lens)[0]) for lens in lenses]
    if poses is not None:
        found[0] = replace(found[0], poses=np.asarray(poses, dtype=np.float64)[list(points.names)])
    return found


def _focal_px(points: Points, size: tuple[int, int]) -> float:
    """One focal length for both axes by the views' vanishing points; that of a common lens where they give none."""
    flat, usual = points.board * np.array([1.0, 1.0, 0.0]), float(max(size))
    board, image = (points.split(part.astype(np.float32)) for part in (flat, points.image))
    try:
        focal = float(cv2.initCameraMatrix2D(board, image, size, 1.0)[0, 0])
    except cv2.error:  # Points of a size beyond single precision.
        return usual
    # The model does not describe lenses outside this range.
    return focal if 0.15 * usual <= focal <= 30.0 * usual else usual


@final
@dataclass(frozen=True)
class _Fitted:
    """A minimum, and the points with outliers marked and sigmas times the ``scales`` of their views, by ``dof``."""

    solved: Solved
    points: Points
    scales: Float[np.ndarray, " views"]
    dof: float = 0.0


@final
@dataclass(frozen=True)
class _Search:
    """The search of a minimum with every distortion free, by the points as given and what is known of the lens."""

    given: Points
    known: Prior

    def best_of(self, begun: list[Bundle]) -> _Fitted:
        """The best minimum of all starts; these may leave out different points: the spread of all compares them."""
        found = [self._descended(one) for one in begun]
        best = min(found, key=lambda one: float(np.log1p(_squares(one.solved.place, self.given)).mean()))
        for _ in range(8):  # Views whose mirrored pose fits better take it, and all is solved again.
            place, points = best.solved.place, best.points
            mirrored = replace(place, poses=best_poses(points, place.intrinsics)[1])
            other = solve(mirrored, points, ~EVERY, self.known).place
            better = _costs(other, points) < 0.99 * _costs(place, points)
            if not better.any():
                break
            poses = np.where(better[:, None], other.facing().poses, place.poses)
            best = self._without_outliers(replace(place, poses=poses))
        return best

    def _descended(self, bundle: Bundle) -> _Fitted:
        """Descend robustly and with few coefficients first: from far off, all five may lead to a wrong minimum."""
        for free in (ORDERS["k1"], EVERY):
            scaled = self.given.scaled(self._judged(bundle, self.given.used)[0])
            bundle = solve(bundle, scaled, free, self.known, Cauchy()).place.facing()
        return self._without_outliers(bundle)

    def _without_outliers(self, place: Bundle) -> _Fitted:
        """Leave out points that are too far off and solve, until nothing changes; points that fit again return."""
        scales, used = np.full(len(self.given.names), np.inf), self.given.used
        for _ in range(9):
            before, was = scales, used
            scales, used = self._judged(place, used)
            points = replace(self.given.scaled(scales), used=used)
            if (used == was).all() and np.allclose(scales, before, rtol=0.1):
                break
            solved = solve(place, points, EVERY, self.known)
            place = solved.place
        return _Fitted(solved, points, scales)

    def _judged(self, place: Bundle, used: Bool[np.ndarray, " points"]) -> tuple[np.ndarray, np.ndarray]:
        """Scatter over sigma of each view, from medians of its used points, and which points are not too far off.

        The pose of a view with few points may fit them all: its scale is at least half of all views'. Its points stay
        where too few would be left to determine its pose.
        """
        view, views, rules = self.given.view, len(self.given.names), self.given.rules
        z = linearised(place, self.given)[0] / self.given.sigma[:, None]
        seen = np.where(used[:, None], z, np.nan)
        own = np.array([robust_sigma(seen[view == k]) for k in range(views)])
        scales = np.maximum(np.maximum(own, 0.5 * robust_sigma(seen)), _least_scale(self.given))
        off = rules.corners.off(z / scales[view, None]).any(axis=1)
        return scales, ~off | (np.bincount(view[~off], minlength=views) < rules.least_corners)[view]


def _of_the_board(likely: _Fitted, given: Points, prior: Prior) -> tuple[_Fitted, list[BoardShape | BoardPoints]]:
    """The minimum with the board as the views show it, and how that differs from its description."""
    found = list[BoardShape | BoardPoints]()
    for differs in (board_shape, board_points):
        try:
            board = differs(likely.solved, likely.points, EVERY, prior, likely.dof)
        except np.linalg.LinAlgError:  # corners that fit no board may lead to derivatives that are no numbers
            break
        if board is not None:
            found.append(board)
            given = replace(given, board=board.points.board)
            likely = _scaled(likely, given, EVERY, prior)
    return likely, found


def check_picture(image_size: object, points: Points) -> None:
    """Refuse a size that no picture has, and corners that lie outside it.

    Raises:
        FitError: with what was found.
    """
    whole = np.asarray(image_size)
    if whole.shape != (2,) or whole.dtype.kind not in "iu" or (whole < 1).any():
        raise FitError(
            f"Expected the picture's (columns, rows), two whole numbers, found {image_size!r:.80}. Give them."
        )
    beyond = np.any((points.image < -_BESIDE_PX) | (points.image > whole - 1 + _BESIDE_PX), axis=1)
    if beyond.sum() > max(_FEW_BESIDE, _PART_BESIDE * beyond.size):
        x, y = points.image[beyond][0]
        raise FitError(
            f"Expected corners within the picture of {whole[0]} x {whole[1]} px, found {int(beyond.sum())} outside, "
            f"such as ({x:.1f}, {y:.1f}). Give points as (x, y), and the size as (columns, rows)."
        )


def _distinct(
    given: Points, least: int, search: Callable[[Points], _Fitted]
) -> tuple[_Fitted, Points, tuple[Outliers, ...]]:
    """The minimum of the views that are measurements of their own, those views, and what was left out."""
    robust, left_out = search(given), tuple[Outliers, ...]()
    scatters = f"scatters more than {given.rules.strange_view:g} times as much as the median view"
    repeats = "repeats another's corners to within a fraction of their scatter: it is no new measurement"
    for rule, what in ((_strange, scatters), (_copies, repeats)):
        out = rule(robust, least)
        if out.any():
            names = (f"view {given.names[k]}" for k in np.flatnonzero(out))
            left_out = (*left_out, *outliers(f"of a view that {what}", names))
            given = given.without(out)
            if len(given.names) < least:
                raise FitError(
                    f"Expected at least {least} different views, found {len(given.names)}, and {int(out.sum())} that "
                    "repeat them. Move the board between pictures."
                )
            robust = search(given)
    return robust, given, left_out


def _strange(robust: _Fitted, least: int) -> Bool[np.ndarray, " views"]:
    """Views that scatter far more than the others, unless too few would be left."""
    strange = robust.scales > robust.points.rules.strange_view * np.median(robust.scales)
    return np.asarray(strange & bool((~strange).sum() >= least))


def _copies(robust: _Fitted, _: int) -> Bool[np.ndarray, " views"]:
    """Views that repeat an earlier one: the errors of a picture that is given twice are no independent ones."""
    points, views = robust.points, range(len(robust.points.names))
    used = [np.flatnonzero((points.view == view) & points.used) for view in views]
    corners, copies = [{tuple(points.board[k]): k for k in mine} for mine in used], np.zeros(len(views), dtype=bool)
    for first, later in combinations(views, 2):
        common = corners[first].keys() & corners[later].keys()
        if not copies[first] and len(common) >= points.rules.least_corners:
            a, b = np.array([(corners[first][at], corners[later][at]) for at in common]).T
            apart2 = ((points.image[a] - points.image[b]) ** 2).mean(axis=1).sum()
            copies[later] |= apart2 < points.rules.copy * (points.sigma[[a, b]] ** 2).sum()
    return copies


def _costs(bundle: Bundle, points: Points) -> Float[np.ndarray, " views"]:
    """Chi-squared of each view."""
    return points.sums(_squares(bundle, points))


def _squares(bundle: Bundle, points: Points) -> Float[np.ndarray, " points"]:
    """Squared residuals in units of sigma; infinite where a point's projection is not finite."""
    square = (linearised(bundle, points)[0] ** 2).sum(axis=1) / points.sigma**2
    return np.where(np.isfinite(square), square, np.inf)


def _least_scale(points: Points) -> float:
    """The least factor on sigma: a sigma below 1e-8 px is rounding."""
    return 1e-8 / float(np.median(points.sigma))


def _scaled(fitted: _Fitted, given: Points, free: Free, prior: Prior) -> _Fitted:
    """Scales by maximum likelihood and the solution with these; all views have one scale unless they differ."""
    solved, points, scales = fitted.solved, fitted.points, np.ones(len(given.names))
    for _ in range(8):
        square, dof = _costs(solved.place, given), 2 * given.sums(np.ones(len(given.view)))
        # Less what the fit uses: a pose, and the trace of the lens's information times its covariance.
        lens = solved.equations.cov()
        dof -= [6 + np.sum(one.marginal()[0] * lens) for one in BundleProblem(points, free).by_view(solved.place)]
        differ = _differ(square, dof)
        own = square / np.maximum(dof, 1.0) if differ else np.full(len(dof), square.sum() / max(dof.sum(), 1.0))
        before, scales = scales, np.maximum(np.sqrt(own), _least_scale(given))
        points = given.scaled(scales)
        solved = solve(solved.place, points, free, prior)
        if not differ or np.allclose(scales, before, rtol=1e-3):
            break
    return _Fitted(solved, points, scales, max(float(dof.sum()), 1.0))


def _differ(square: Float[np.ndarray, " views"], dof: Float[np.ndarray, " views"]) -> bool:
    """Bartlett's test of equal variances (1937), over views with at least four degrees of freedom."""
    if len(dof) < 2 or not ((dof >= 4) & (square > 0)).all():
        return False
    ratio = float((dof * np.log(square.sum() / dof.sum() / (square / dof))).sum())
    correction = 1 + ((1 / dof).sum() - 1 / dof.sum()) / (3 * (len(dof) - 1))
    return chi2_test(ratio / correction, len(dof) - 1.0).found


def _choose_order(full: _Fitted, prior: Prior) -> tuple[Choice[Solved], Float[np.ndarray, "n n"] | None]:
    """Every order, each solved from the one before with other coefficients at 0, and what the choice adds to cov.

    Where a large part of the information on focal length or centre is the prior's, the data are too few to separate a
    coefficient from a pose. All coefficients then stay free, each within its prior, and there is no choice (None).

    The criterion is BIC with an estimated scale of the noise: n ln(chi2 / n) replaces chi2. A residual below 1e-7 px is
    rounding, not noise: orders that differ only there are equally good.
    """
    points, solved, tried = full.points, full.solved, list[Attempt[Solved]]()
    samples, rounding = 2 * int(points.used.sum()), float(((1e-7 / points.sigma[points.used]) ** 2).sum())
    # p1 and p2 come together, at the price of one.
    pair = np.array(["p1 p2" in name for name in ORDERS])
    coefficients = np.array([free.sum() for free in ORDERS.values()]) - ORDERS["no distortion"].sum()
    against = 2 * np.log(points.rules.further_order) * (coefficients - pair)
    for price, (name, free) in reversed(list(zip(against, ORDERS.items(), strict=True))):
        if tried:
            above = Bundle(np.where(free, solved.place.intrinsics, 0.0), solved.place.poses)
            solved = solve(above, points, free, prior)
        parameters = int(free.sum()) + solved.place.poses.size
        noise = max(float(_costs(solved.place, points).sum()), rounding) / samples
        criterion = bic(samples * float(np.log(noise)), float(parameters), samples) + float(price)
        tried.insert(0, Attempt(name, parameters, criterion, solved))
    known = np.diag(full.solved.equations.cov()) * np.diag(prior.precision)
    if known[:4].max() > points.rules.prior_share:
        return Choice(tried[-1], tuple(tried)), None
    orders = choose(tried)
    # Akaike's price of p1 and p2 is that of one, too: with that of both, a pair that is there has too little weight.
    return orders, orders.spread(
        samples,
        lambda of: np.append(of.place.intrinsics, of.place.poses),
        against + 2.0 * pair,
        lambda of: of.equations.joint_cov(),
        points.rules.full_order,
    )
