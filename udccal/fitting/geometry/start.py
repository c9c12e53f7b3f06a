"""From arrays to the robust minimum of a bundle: views checked, starts, outliers left out.

The focal length starts from homographies (Zhang, IEEE PAMI 22, 2000), poses from flat boards (Collins and Bartoli, IJCV
109, 2014). A flat board seen from afar looks almost the same in two poses, mirrored at the line of sight. Both are
kept: the second is tried again once the lens is known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import final

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from udccal.errors import FitError
from udccal.fitting.engine.gaussian import Prior
from udccal.fitting.engine.robust import outliers, robust_sigma
from udccal.fitting.geometry.bundle import (
    EVERY,
    ORDERS,
    Bundle,
    GeometryRules,
    Intrinsics,
    Points,
    Solved,
    linearised,
    solve,
)
from udccal.result import Outliers


@final
@dataclass(frozen=True)
class Gathered:
    """Points of the usable views, the points left out, and sentences about these."""

    points: Points
    outliers: tuple[Outliers, ...]
    notes: tuple[str, ...]


def gather(
    board: Sequence[np.ndarray], image: Sequence[np.ndarray], sigmas: Sequence[np.ndarray] | None, rules: GeometryRules
) -> Gathered:
    """Every finite point of every view that determines a pose; arguments as for ``fit_geometry``."""
    if len({len(board), len(image), len(image if sigmas is None else sigmas)}) > 1:
        raise FitError(
            f"Expected as many views on the board as in pictures (and of sigmas), found {len(board)} and {len(image)}. "
            "Give one array of each per view."
        )
    # Without sigmas any common value serves: its scale is estimated.
    given = [np.full(len(pixels), 0.1) for pixels in image] if sigmas is None else sigmas
    lost: list[str] = []
    notes: list[str] = []
    parts = {-1: (np.zeros((0, 3)), np.zeros((0, 2)), np.zeros(0), np.zeros(0, dtype=np.int64))}
    for number, arrays in enumerate(zip(board, image, given, strict=True)):
        points, pixels, own = _view(number, *(np.asarray(a, dtype=np.float64) for a in arrays))
        good = np.isfinite(points).all(axis=1) & np.isfinite(pixels).all(axis=1) & np.isfinite(own) & (own > 0)
        lost += [f"view {number}, point {k}" for k in np.flatnonzero(~good)]
        part = (points[good], pixels[good], own[good], np.flatnonzero(good))
        if complaint := _complaint(part[0], part[1], list(parts.values()), rules):
            notes.append(f"View {number} is left out: {complaint}")
        else:
            parts[number] = part
    points, pixels, own, index = (np.concatenate(same) for same in zip(*parts.values(), strict=True))
    view = np.repeat(np.arange(len(parts)) - 1, [len(part[0]) for part in parts.values()])
    found = Points(points, pixels, own, view, index, np.ones(len(points), dtype=bool), tuple(parts)[1:])
    return Gathered(found, outliers("not a finite position with a positive sigma", lost), tuple(notes))


def _view(number: int, points: np.ndarray, pixels: np.ndarray, own: np.ndarray) -> tuple[np.ndarray, ...]:
    """Board points (n, 3), pixels (n, 2) and sigma (n,) of a view, whatever the shape OpenCV gave them."""
    n = len(pixels)
    if points.shape not in ((n, 3), (n, 1, 3)) or pixels.shape not in ((n, 2), (n, 1, 2)) or own.shape != (n,):
        raise FitError(
            f"Expected board points (n, 3), image points (n, 2) and sigmas (n,) of equal n in view {number}, found "
            f"{points.shape}, {pixels.shape} and {own.shape}. Give each seen corner its point on the board."
        )
    return points.reshape(-1, 3), pixels.reshape(-1, 2), own


def _complaint(board: np.ndarray, image: np.ndarray, before: list[tuple[np.ndarray, ...]], rules: GeometryRules) -> str:
    """Why a view cannot be used; empty when it can."""
    least = rules.least_corners
    if len(board) < least:
        return f"expected at least {least} points, found {len(board)}. Bring more of the board into the picture."
    for points, what in ((board, "on the board"), (image, "in the picture")):
        spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        if spread[1] <= 1e-3 * spread[0]:
            return f"its points lie on one line {what} and hold no pose. Show at least two rows of corners."
    if any(np.array_equal(image, other[1]) and np.array_equal(board, other[0]) for other in before):
        return "it repeats another view to the last digit, and so adds nothing. Capture every view anew."
    return ""


def starts(
    points: Points, size: tuple[int, int], given: Intrinsics | None, poses: Float[np.ndarray, "views 6"] | None
) -> list[Bundle]:
    """Starts: from the given intrinsics, and from the views' vanishing points or else a common lens."""
    centred = Intrinsics(np.full(2, _focal_px(points, size)), (np.array(size) - 1) / 2, np.zeros(5)).vector
    found = [Bundle(centred, best_poses(points, centred)[0])]
    if given is not None:
        found.insert(0, Bundle(given.vector, poses if poses is not None else best_poses(points, given.vector)[0]))
    return found


def best_poses(
    points: Points, intrinsics: Float[np.ndarray, "9"]
) -> tuple[Float[np.ndarray, "views 6"], Float[np.ndarray, "views 6"]]:
    """The best pose of each view at these intrinsics, and the one mirrored at the line of sight."""
    pairs = [_pose_pair(points, view, Intrinsics.of(intrinsics)) for view in range(len(points.names))]
    return np.array([first for first, _ in pairs]), np.array([second for _, second in pairs])


def facing(poses: Float[np.ndarray, "views 6"]) -> Float[np.ndarray, "views 6"]:
    """The same pictures with every board in front of the camera, and rotations of at most half a turn.

    Behind the camera, a flat board turned by half a turn about its normal projects to the same points.
    """
    side = np.where(poses[:, 5:] < 0, -1.0, 1.0)
    turn = Rotation.from_rotvec(poses[:, :3]) * Rotation.from_rotvec(np.pi * (side < 0) * np.array([0.0, 0.0, 1.0]))
    return np.hstack([turn.as_rotvec(), side * poses[:, 3:]])


def _pose_pair(points: Points, view: int, lens: Intrinsics) -> tuple[np.ndarray, np.ndarray]:
    mine = (points.view == view) & points.used
    board, image = points.board[mine], points.image[mine]
    good = _consistent(board, image)
    flat = np.linalg.svd(board - board.mean(axis=0), compute_uv=False)
    method = cv2.SOLVEPNP_IPPE if flat[2] <= 1e-6 * flat[0] else cv2.SOLVEPNP_SQPNP
    try:
        _, turns, shifts, _ = cv2.solvePnPGeneric(board[good], image[good], lens.matrix, lens.distortion, flags=method)
    except cv2.error:
        turns, shifts = (), ()
    found = [np.concatenate([t.ravel(), s.ravel()]) for t, s in zip(turns, shifts, strict=True)]
    found = [pose for pose in found if np.isfinite(pose).all()] or [_ahead(board, image, lens)]
    return found[0], found[-1]


def _ahead(board: np.ndarray, image: np.ndarray, lens: Intrinsics) -> np.ndarray:
    """A pose that faces the camera, at the distance and place by the points' spread."""
    (across, down), middle = image.mean(axis=0), board.mean(axis=0)
    seen = max(float(np.linalg.norm(image - image.mean(axis=0))), 1e-9)
    distance = lens.matrix[0, 0] * float(np.linalg.norm(board - middle)) / seen
    return np.concatenate([np.zeros(3), np.linalg.solve(lens.matrix, [across, down, 1.0]) * distance - middle])


def _consistent(board: np.ndarray, image: np.ndarray) -> Bool[np.ndarray, " n"]:
    """Points that one homography puts near their places; all points where there are too few for it.

    The limit is a part of the board's size: distortion bends straight lines by less, and a corner with its neighbour's
    number is off by more.
    """
    if len(board) >= 12:
        limit = max(0.02 * float(np.ptp(image, axis=0).max()), 1.0)
        _, inside = cv2.findHomography(board[:, :2], image, cv2.RANSAC, limit)
        if inside is not None and inside.sum() >= max(6, len(board) // 3):
            return inside.ravel().astype(bool)
    return np.ones(len(board), dtype=bool)


def _focal_px(points: Points, size: tuple[int, int]) -> float:
    """One focal length for both axes by the views' vanishing points; that of a common lens where they give none."""
    views = [points.view == k for k in range(len(points.names))]
    board = [(points.board[mine] * np.array([1.0, 1.0, 0.0])).astype(np.float32) for mine in views]
    image = [points.image[mine].astype(np.float32) for mine in views]
    focal, usual = float(cv2.initCameraMatrix2D(board, image, size, 1.0)[0, 0]), float(max(size))
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
