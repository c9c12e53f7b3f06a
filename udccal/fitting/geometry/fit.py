"""The geometry term: intrinsics and distortion from arrays, or from a rig's boards with the camera's mounting.

One view of a rig shows the board parallel to the panel. Its axes are then the panel's: the inverse of its pose is
``R_panel_camera``. Stand-off and panel position stay nominal here: a far board does not determine them. The wire does.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

import jax
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from udccal.arguments import check_kind, check_optional, check_positions
from udccal.board.charuco import board_points_mm
from udccal.errors import FitError
from udccal.fitting.engine.gaussian import Posterior, Prior, square_root
from udccal.fitting.engine.misfit import excess_sigma
from udccal.fitting.engine.report import estimates, priors_of, residual_sample
from udccal.fitting.geometry.bundle import INTRINSIC_NAMES, LENS, RULES, GeometryRules, Intrinsics, Lens, Poses
from udccal.fitting.geometry.calibrated import CalibratedViews, folded, turn_with
from udccal.fitting.geometry.data import BoardView, GeometryData, gather
from udccal.fitting.geometry.views import calibrate_views, check_picture
from udccal.models.geometry import Geometry, panel_directions, project_directions
from udccal.mounting import angles_deg, turned_by
from udccal.numerics import in_float64
from udccal.result import Diagnostic, FitResult, FitStatus, Outliers

# Scatter in addition to noise of the board on the jig, and of the median other view: a plan reads them.
ON_JIG, BY_HAND = "corner_scatter_on_jig", "corner_scatter_by_hand"
_NAMES = (*INTRINSIC_NAMES, "tilt_deg", "roll_deg", "yaw_deg")
# Between a pixel and the place where the direction seen there appears: rounding, where the distortion does not fold.
_ROUNDING_PX = 0.05


def fit_geometry(
    board_points: Sequence[Float[np.ndarray, "..."]],
    image_points: Sequence[Float[np.ndarray, "..."]],
    image_size: tuple[int, int],
    start: Geometry | None = None,
    sigmas: Sequence[Float[np.ndarray, " _"]] | None = None,
    *,
    prior: Prior | None = None,
    rules: GeometryRules = RULES,
) -> FitResult[Geometry]:
    """Fit the lens to views of flat boards, given as arrays; ``views.calibrate_views`` gives their poses as well.

    The term's axes are the camera's, and its posterior holds the boards still: ``projection_sigma_px`` gives the sigma
    of rays fixed to the boards.

    Args:
        board_points: per view, points on the board (z = 0) in any unit of length, (n, 3) or (n, 1, 3).
        image_points: per view, the same points in px, (n, 2) or (n, 1, 2) as OpenCV gives them. (0, 0) is the centre of
            the top-left pixel; NaN where not seen.
        image_size: (columns, rows).
        start: intrinsics to start from. The views' vanishing points (Zhang, 2000) give another start in any case; the
            lower minimum wins.
        sigmas: per view, one sigma in px of each point, up to a common factor; without it all points count alike.
        prior: on the intrinsics, in the order of ``INTRINSIC_NAMES``; with it a single view may be enough.
        rules: see ``GeometryRules``.

    Returns:
        the term, without rotation and pupil, with estimates of the intrinsics. The order of the distortion is the one
        with the lowest BIC (Schwarz, 1978). Status ``TOO_FEW_DATA`` says what to capture.

    Raises:
        FitError: when the arrays do not belong together.
    """
    check_optional(start, Geometry, FitError)
    check_optional(prior, Prior, FitError)
    check_kind(rules, GeometryRules, "Leave it out for the default.", FitError)
    gathered = gather(board_points, image_points, sigmas, rules)
    check_picture(image_size, gathered.points)
    lens = start or Intrinsics.centred(float(max(image_size)), image_size).camera()
    try:
        views = calibrate_views(gathered, image_size, start, prior)
    except FitError as error:
        return FitResult.failed("geometry", lens, FitStatus.TOO_FEW_DATA, str(error))
    if views.rms_px > rules.no_corners_px:
        # No error bars hold for what is no lens.
        return FitResult.failed("geometry", lens, views.status, *views.notes)
    return _result(views, np.zeros(3), prior)


def fit_boards(data: GeometryData) -> FitResult[Geometry]:
    """Fit lens and mounting to a session's boards.

    Every corner has its own noise and a scatter common to all (paper that is not flat, blur that a saddle does not
    describe), which the fit estimates.

    Args:
        data: boards, one of them parallel to the panel; at least 3 usable ones, or any number with a prior.

    Returns:
        the term, with estimates of the intrinsics and of tilt, roll and yaw; the status says what to capture. With
        fewer than 3 views beside the parallel one it is ``TOO_FEW_DATA``: the prior then decides about the lens.
    """
    rules, usable = data.rules, [view for view in data.views if view.usable(data.rules)]
    lost, status = tuple(_lost(data)), FitStatus.TOO_FEW_DATA
    least, parallel = 1 if data.prior else rules.least_views, sum(view.parallel for view in usable)
    if len(usable) < least or not parallel:
        if sum(view.clipped > rules.most_clipped for view in data.views) > len(data.views) / 2:
            status = FitStatus.SATURATED
        found = f"Expected {least} views with a board and one of them parallel to the panel, found {len(usable)} "
        return FitResult.failed("geometry", data.nominal, status, *lost, f"{found}and {parallel}.")
    try:
        bundle, scatter_px = _calibrated(usable, data)
    except FitError as error:
        return FitResult.failed("geometry", data.nominal, status, *lost, str(error))
    views = [usable[k] for k in bundle.points.names]
    on_jig = [k for k, view in enumerate(views) if view.parallel]
    if bundle.status is status or not on_jig:
        tilt = () if on_jig else ("No usable view shows the board parallel to the panel; capture that view again.",)
        return FitResult.failed("geometry", data.nominal, status, *lost, *bundle.notes, *tilt)
    result = _result(bundle, np.asarray(data.nominal.pupil_mm, dtype=np.float64), data.prior, on_jig)
    left_out, sentences = _outliers(bundle, views)
    poor = bundle.rms_px > rules.worst_rms_px and bundle.chi2_dof > rules.worst_chi2_dof
    mounting = "Stand-off and panel position are the rig's nominal ones; the wire fit refines them."
    by_hand = [k for k in range(len(views)) if k not in on_jig]
    few: tuple[str, ...] = ()
    if len(by_hand) < rules.least_views:
        few = (
            f"Expected at least {rules.least_views} usable views of the board held by hand, found {len(by_hand)}: the "
            "rig description decides about the lens. Capture more, in varied poses.",
        )
    scatter = {
        "corner_scatter_beside_noise": scatter_px[0],
        ON_JIG: np.median(scatter_px[1:][on_jig]),
        BY_HAND: np.median(scatter_px[1:][by_hand or on_jig]),
    }
    return replace(
        result,
        status=FitStatus.POOR_FIT if poor else FitStatus.TOO_FEW_DATA if few else result.status,
        diagnostics=(*result.diagnostics, *(Diagnostic(name, float(size), "px") for name, size in scatter.items())),
        notes=(*lost, *few, *result.notes, *sentences, mounting),
        outliers=left_out,
    )


@in_float64
def projection_sigma_px(
    result: FitResult[Geometry] | Posterior[Geometry], pixels: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n 2"]:
    """Sigma of the places at which directions fixed in panel coordinates appear; it includes the model error found.

    Args:
        result: of ``fit_boards`` or ``fit_geometry``, with its posterior, or a posterior alone.
        pixels: (x, y) in px, where the directions appear.

    Returns:
        one sigma in px along x and along y, per pixel; errors as for ``FitResult.sigma_of``.

    Raises:
        FitError: when the fitted distortion folds before a pixel, so that no direction appears there, pixels are none
            on a sensor, or ``result`` is neither.
    """
    if not isinstance(result, Posterior):
        check_kind(result, FitResult, "Give the result of fit_boards or fit_geometry.", FitError)
    check_positions(pixels, "n", "Give (x, y) in px where directions appear.", FitError)
    directions, places = jax.jit(panel_directions)(result.term, pixels), jax.jit(project_directions)
    lost = ~(np.abs(np.asarray(places(result.term, directions)) - pixels).max(axis=1) < _ROUNDING_PX)
    if lost.any():
        raise FitError(folded(np.asarray(pixels)[lost]))
    return result.sigma_of(lambda term: np.asarray(places(term, directions)))


def _calibrated(views: Sequence[BoardView], data: GeometryData) -> tuple[CalibratedViews, Float[np.ndarray, " n"]]:
    """The bundle, and the scatter in addition to noise in px by axis: of all views, then of each in use."""
    points = [board_points_mm(view.spec)[view.corners.ids] for view in views]
    seen, scatter_px = [view.corners.xy for view in views], np.full(1, data.rules.start_scatter_px)
    for _ in range(8):
        # No lens follows its model more closely than a thousandth of a pixel.
        sigmas = [np.maximum(np.hypot(view.corners.sigma, scatter_px[0]), 1e-3) for view in views]
        gathered = gather(points, seen, sigmas, data.rules)
        bundle = calibrate_views(gathered, data.image_size, data.nominal, data.prior)
        before, scatter_px = scatter_px, _scatter_px(bundle, views)
        if abs(scatter_px[0] - before[0]) <= 0.05 * before[0]:
            break
    return bundle, scatter_px


def _scatter_px(bundle: CalibratedViews, views: Sequence[BoardView]) -> Float[np.ndarray, " n"]:
    """The scatter that gives residuals their expected size, significant or not: plans need the estimate itself."""
    points = bundle.points
    noise = [views[points.names[v]].corners.sigma[k] for v, k in zip(points.view, points.index, strict=True)]
    variance = np.maximum(np.array(noise), 1e-3) ** 2
    square = (bundle.residuals_px**2).sum(axis=1)
    spent = (sum(bundle.free) + 6 * len(points.names)) / (2 * points.used.sum())
    # A floor keeps fits with nearly as many parameters as data from having no degrees of freedom.
    left = max(1 - spent, 0.05)
    groups = [points.used, *(points.used & (points.view == view) for view in range(len(points.names)))]
    return np.array(
        [excess_sigma(square[g], variance[g], np.ones(g.sum()), 2 * left * g.sum(), chance=0.5) for g in groups]
    )


def _lost(data: GeometryData) -> Iterator[str]:
    rules = data.rules
    lost = [view.step_id for view in data.views if len(view.corners.ids) < rules.least_corners]
    clipped = [view.step_id for view in data.views if view.clipped > rules.most_clipped]
    if lost:
        yield f"No board (fewer than {rules.least_corners} corners) in {', '.join(lost)}."
    if clipped:
        yield f"More than {rules.most_clipped:.0%} of the samples clipped in {', '.join(clipped)}."


def _result(
    bundle: CalibratedViews, pupil_mm: Float[np.ndarray, "3"], prior: Prior | None, on_jig: Sequence[int] | None = None
) -> FitResult[Geometry]:
    """The result of a bundle, with the camera's mounting by the views ``on_jig``; without any, axes are the camera's.

    A pattern in the residuals is modelled as an error of the principal point, which moves every place by its size.
    """
    still, rotation = (range(len(bundle.poses)), Rotation.identity()) if on_jig is None else (on_jig, None)
    x, cov = with_angles(bundle.intrinsics.vector, bundle.poses, bundle.cov, still, rotation)
    points, use, count = bundle.points, bundle.points.used, len(_NAMES) if on_jig else LENS
    factor = np.hstack([square_root(cov), bundle.pattern_px * np.eye(len(x))[:, 2:4]])
    posterior = Posterior(x, factor, partial(term_at, pupil=pupil_mm))
    z = bundle.residuals_px[use] / points.sigma[use, None]
    notes, held = bundle.notes, [name for name, free in zip(INTRINSIC_NAMES, bundle.free, strict=True) if not free]
    if held:
        zero = f"Held at 0, as the data do not ask for it: {', '.join(held)}."
        notes = (*notes, f"{zero} Their sigmas say how far from 0 they may be.")
    priors = None if prior is None else priors_of(INTRINSIC_NAMES, prior.mean, prior.sigma)
    diagnostics = (
        ("rms_reprojection", bundle.rms_px, "px"),
        ("views", len(points.names), "1"),
        ("corners_used", use.sum(), "1"),
        ("corners_rejected", (~use).sum(), "1"),
        ("iterations", bundle.iterations, "1"),
        ("views_disagree_p", bundle.disagreement.p_value, "1"),
        ("variance_factor", bundle.disagreement.inflation, "1"),
        ("residual_pattern_p", bundle.pattern.p_value, "1"),
        ("residual_pattern", bundle.pattern_px, "px"),
    )
    return FitResult(
        name="geometry",
        term=posterior.term_at(x),
        status=bundle.status,
        estimates=estimates("geometry", _NAMES[:count], x[:count], cov[:count, :count], priors),
        cov=cov[:count, :count],
        chi2_dof=bundle.chi2_dof,
        samples=2 * int(use.sum()),
        candidates=bundle.candidates,
        diagnostics=tuple(Diagnostic(name, float(value), unit) for name, value, unit in diagnostics),
        notes=notes,
        outliers=bundle.outliers,
        residuals=residual_sample(np.repeat(points.image[use], 2, axis=0), z.ravel()),
        posterior=posterior,
    )


def with_angles(
    intrinsics: Lens,
    poses: Poses,
    cov: Float[np.ndarray, "n n"],
    views: Sequence[int],
    turn: Rotation | None = None,
) -> tuple[Float[np.ndarray, "12"], Float[np.ndarray, "12 12"]]:
    """The argument of ``term_at``, and its covariance; the camera's axes turn with the boards of some views.

    Args:
        intrinsics, poses: of a bundle.
        cov: of all of them, one after another.
        views: their boards are at rest.
        turn: of the camera against these boards; without it they have the panel's axes, in the mean.
    """
    turn = Rotation.from_rotvec(-poses[views, :3]).mean() if turn is None else turn
    near = [Rotation.from_rotvec(step) for step in 1e-5 * np.vstack([np.eye(3), -np.eye(3), np.zeros((1, 3))])]
    angles = np.array([angles_deg((turn * step).as_rotvec()) for step in near])
    slope = (angles[:3] - angles[3:6]).T / 2e-5
    picks = np.vstack([np.eye(LENS, len(cov)), -slope @ turn_with(poses, views)])
    return np.append(intrinsics, angles[6]), picks @ cov @ picks.T


def term_at(x: Float[np.ndarray, "12"], pupil: Float[np.ndarray, "3"]) -> Geometry:
    """The term of ``x``: intrinsics, tilt, roll and yaw in degrees; ``pupil`` in mm in panel coordinates."""
    return replace(Intrinsics.of(x).camera(), rotation_rad=turned_by(x[LENS:]), pupil_mm=pupil)


def _outliers(bundle: CalibratedViews, views: list[BoardView]) -> tuple[tuple[Outliers, ...], tuple[str, ...]]:
    """What was left out, corners by step and number, and one sentence per view that lost corners."""
    points, places, sentences = bundle.points, [], []
    for k, view in enumerate(views):
        ids = view.corners.ids[points.index[(points.view == k) & ~points.used]]
        places += [f"{view.step_id} corner {corner}" for corner in ids]
        if len(ids):
            far = f"further than {points.rules.corners.sigma:g} robust sigma of their view from the model"
            sentences.append(f"{view.step_id}: corners {', '.join(map(str, ids))} left out, {far}.")
    found = points.rules.corners.listed(places)
    return (*(other for other in bundle.outliers if all(other.rule != f.rule for f in found)), *found), tuple(sentences)
