"""Geometry: corners of a session's boards, as a profile's lens images them; the pose of each board is solved for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from udccal.board.charuco import board_points_mm
from udccal.fitting.engine.gaussian import square_root
from udccal.fitting.geometry.bundle import (
    INTRINSIC_NAMES,
    LENS,
    RULES,
    Bundle,
    Intrinsics,
    Points,
    in_sigma,
    linearised,
    solve,
)
from udccal.fitting.geometry.calibrated import rms_px
from udccal.fitting.geometry.data import BoardView, best_poses, gather, read_geometry
from udccal.fitting.geometry.fit import BY_HAND, ON_JIG
from udccal.models.geometry import Geometry
from udccal.profiles.profile import Profile
from udccal.result import FitResult
from udccal.sessions.store import Session
from udccal.validation.checks import Check, Judged, ZMap, at_most, chi2_check, unusable
from udccal.validation.limits import ValidationLimits
from udccal.validation.prediction import Prediction


def validate_geometry(profile: Profile, session: Session, limits: ValidationLimits) -> Judged:
    """Judge a session's boards; see ``judge_geometry``.

    Raises:
        SessionError: when a file of the session is missing or damaged.
        FitError: when a board's dictionary is unknown.
    """
    data = read_geometry(session, profile.noise.term)
    return judge_geometry(data.views, profile.geometry, data.image_size, limits)


def judge_geometry(
    views: Sequence[BoardView], result: FitResult[Geometry], image_size: tuple[int, int], limits: ValidationLimits
) -> Judged:
    """Judge corners with free poses, patterns in them, and the camera's turn by the board on its jig."""
    views = [view for view in views if view.usable()]
    if not views:
        return unusable("geometry", "No board shows enough corners. Capture the boards again, evenly lit and sharp.")
    lens = Intrinsics.of_geometry(result.term).vector
    given = _points(views, result)
    if not given.names:
        return unusable("geometry", "No board holds a pose. Capture boards that show two rows of corners or more.")
    points, place = _posed(given, lens)
    strange = _strange_check([views[k].step_id for k in given.names if k not in points.names])
    if not points.names:
        return unusable("geometry", strange[0].what)
    each = [_prediction(points, place, result, view) for view in range(len(points.names))]
    ratios = np.array([one.chi2 / one.dof for one in each])
    noise = float(np.sqrt(2 * np.mean(points.sigma[points.used] ** 2)))
    # Boards by hand scatter unequally, by blur and light: as in the fit, each view has a scale of its own.
    points = points.scaled(np.sqrt(np.maximum(ratios, 1.0)))
    found = _prediction(points, place, result)
    cell, shape = points.cells(image_size)[points.used], 2 * (points.rules.pattern_cells,)
    test, size = found.pattern(np.repeat(cell, 2) * 2 + np.tile([0, 1], len(cell)))
    unit = float(np.sqrt(np.mean(points.sigma[points.used] ** 2)))
    off = rms_px(linearised(place, points)[0], points)
    checks = (
        at_most(
            "geometry",
            "pattern of the corners",
            size * unit,
            limits.rays_px,
            "px",
            f"Corners lie {off:.3f} px (RMS) from where the profile's lens images them, {noise:.3f} px by "
            f"noise alone; {'they share directions over the sensor' if test.found else 'no pattern is seen'}.",
        ),
        chi2_check(
            "geometry",
            float(np.median(ratios)),
            int(np.median([one.dof for one in each])),
            result.chi2_dof,
            limits.board_factor,
            limits,
            "Corners of the middle one of the boards",
        ),
        *strange,
        *_jig_check(views, points, place, result.term, limits),
    )
    caption = (
        "Corners, seen less predicted, mean over a part of the sensor in sigma: along x at the left, y at the right."
    )
    return Judged(checks, ZMap(_cell_means(found.z, cell, shape), "x", "y", caption))


def _points(views: Sequence[BoardView], result: FitResult[Geometry]) -> Points:
    """The corners of all views, with noise and the scatter that the profile states."""
    stated = [result.diagnostic(ON_JIG if view.parallel else BY_HAND) for view in views]
    scatter = [RULES.start_scatter_px if own is None else own for own in stated]
    return gather(
        [board_points_mm(view.spec)[view.corners.ids] for view in views],
        [view.corners.xy for view in views],
        [np.maximum(np.hypot(v.corners.sigma, own), 1e-3) for v, own in zip(views, scatter, strict=True)],
    ).points


def _posed(points: Points, lens: Float[np.ndarray, "9"]) -> tuple[Points, Bundle]:
    """The best pose of every view with the lens held, without outliers, which are marked.

    A view of which they leave too few corners, or less than half, is left out whole: it has no pose that could be told.
    """
    place, held = Bundle(lens, best_poses(points, lens)[0]), np.zeros(LENS, dtype=bool)
    for _ in range(2):
        place = solve(place, points, held).place
        size = np.abs(linearised(place, points)[0] / points.sigma[:, None]).max(axis=1)
        points = replace(points, used=~RULES.corners.off(size))
    every = np.bincount(points.view, minlength=len(points.names))
    strange = points.sums(np.ones(len(points.used))) < np.maximum(RULES.least_corners, 0.5 * every)
    points, place = points.without(strange), Bundle(lens, place.poses[~strange])
    return points, solve(place, points, held).place if points.names else place


def _prediction(points: Points, place: Bundle, result: FitResult[Geometry], only: int | None = None) -> Prediction:
    """Errors of the corners in use, of all views or ``only`` one; poses are free, the lens has its covariance."""
    here = points.used if only is None else points.used & (points.view == only)
    z, jacobian = (part[here] for part in in_sigma(place, points))
    view = points.view[here]
    own = np.zeros((2 * len(z), 6 * len(np.unique(view))))
    for k, name in enumerate(np.unique(view)):
        mine = view == name
        own[np.repeat(mine, 2), 6 * k : 6 * k + 6] = np.linalg.qr(jacobian[mine, :, LENS:].reshape(-1, 6))[0]
    names = [one.name for one in result.estimates[: len(result.cov)]]
    stated = tuple(names[:LENS]) == INTRINSIC_NAMES
    lens = square_root(result.cov[:LENS, :LENS]) if stated else np.zeros((LENS, 0))
    return Prediction(z.ravel(), own, jacobian[:, :, :LENS].reshape(-1, LENS) @ lens)


def _cell_means(
    z: Float[np.ndarray, " n"], cell: Int[np.ndarray, " corners"], shape: tuple[int, int]
) -> Float[np.ndarray, "rows columns"]:
    """Means over each part in sigmas of the mean, x beside y; NaN where there are no corners."""
    count = np.bincount(cell, minlength=shape[0] * shape[1])
    with np.errstate(invalid="ignore"):
        maps = [
            np.where(count > 0, np.bincount(cell, z[axis::2], len(count)) / np.sqrt(count), np.nan).reshape(shape)
            for axis in (0, 1)
        ]
    return np.hstack([maps[0], np.full((shape[0], 1), np.nan), maps[1]])


def _strange_check(step_ids: Sequence[str]) -> tuple[Check, ...]:
    """The failed check of views that have no pose; none where every view has one."""
    if not step_ids:
        return ()
    what = (
        f"In {', '.join(step_ids)}, most corners lie elsewhere than the profile's lens shows those of a flat board. "
        "See whether the board moved or bent there, and capture it again."
    )
    return (at_most("geometry", "strange views", float(len(step_ids)), 0.0, "1", what),)


def _jig_check(
    views: Sequence[BoardView], points: Points, place: Bundle, term: Geometry, limits: ValidationLimits
) -> tuple[Check, ...]:
    """The camera's turn against the panel by the boards that stand parallel to it."""
    parallel = [k for k, name in enumerate(points.names) if views[name].parallel]
    if not parallel:
        return ()
    seen = Rotation.from_rotvec(-place.facing().poses[parallel, :3]).mean()
    angle = np.rad2deg((seen * Rotation.from_rotvec(np.asarray(term.rotation_rad)).inv()).magnitude())
    what = f"By the board on its jig, the camera is turned by {angle:.4f}° against the profile."
    return (at_most("geometry", "camera's turn", angle, limits.jig_deg, "deg", what),)
