"""Bundle adjustment: intrinsics, distortion and one pose per view from points of known position on a flat board.

Array functions only: corners from a ChArUco board through a panel and from a chessboard in a plain photograph alike.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from udccal.errors import FitError
from udccal.fitting.geometry.bundle_evidence import Evidence, weigh
from udccal.fitting.geometry.bundle_noise import (
    OUTLIER_RULE,
    STRANGE_RULE,
    Scatter,
    covariance,
    least_scale,
    leverages,
    maximum_likelihood,
    strange_views,
)
from udccal.fitting.geometry.bundle_orders import (
    ORDERS,
    Ordered,
    choose_order,
    free_intrinsics,
    settle,
)
from udccal.fitting.geometry.bundle_points import MIN_POINTS, Gathered, Points, gather
from udccal.fitting.geometry.bundle_solve import NO_PRIOR, Bundle, Prior, Solved, residuals_px, solve
from udccal.fitting.geometry.bundle_start import facing, starts
from udccal.fitting.geometry.calibrated_views import CalibratedViews
from udccal.models.geometry import Geometry
from udccal.result import FitStatus, Outliers

# Without a prior, fewer views do not tell a lens; with one, a single view tells at least its pose.
MIN_VIEWS = 3
# A focal length or centre less certain than this (of the focal length, of the picture's width) counts as not told:
# beyond it the model is not linear over a sigma, and an error bar would not be true.
MOST_UNCERTAIN = 0.05
_MOST_PLACES = 20
# A view that scatters this many times as much as the median view is worth a sentence.
_SCATTERS_MORE = 3.0


def calibrate_views(
    object_points: Sequence[Float[np.ndarray, "_ 3"]],
    image_points: Sequence[Float[np.ndarray, "_ 2"]],
    image_size: tuple[int, int],
    start: Geometry | None = None,
    sigmas: Sequence[Float[np.ndarray, " _"]] | None = None,
    *,
    prior: Prior | None = None,
    start_poses: Float[np.ndarray, "views 6"] | None = None,
) -> CalibratedViews:
    """Calibrate a camera from views of flat boards.

    Args:
        object_points: per view, points on the board (z = 0) in any unit of length.
        image_points: per view, the same points in px, (0, 0) the centre of the top-left pixel; NaN where not seen.
        image_size: (columns, rows).
        start: intrinsics to start from. The views' vanishing points (Zhang, 2000) give another start in any case; the
            lower minimum wins.
        sigmas: per view, one sigma in px of each point, up to a common factor; without it all points count alike.
        prior: what is known of the intrinsics beforehand; with it a single view may do.
        start_poses: per view, a pose to start from, with ``start``.

    The order of the distortion is the one with the lowest BIC (Schwarz, 1978) on the points that remain after
    outliers are left out.

    Raises:
        FitError: with fewer than 3 usable views (1 with a prior), each of 6 finite points that are not on one line.
    """
    gathered = gather(object_points, image_points, sigmas)
    wanted, known = (MIN_VIEWS, NO_PRIOR) if prior is None else (1, prior)
    _check(gathered, len(object_points), wanted)
    points, outliers = gathered.points, gathered.outliers
    full, scattered, agree = _settled(points, image_size, start, start_poses, known)
    strange = strange_views(scattered, points)
    if strange.any() and (~strange).sum() >= wanted:
        outliers = (*outliers, _whole_views(points, strange))
        points = points.without(strange)
        full, scattered, agree = _settled(points, image_size, start, start_poses, known)
    every = free_intrinsics(ORDERS[-1][1])
    full, scatter = maximum_likelihood(full, scattered, points, every, known)
    ordered = choose_order(full, scatter.points, known)
    finished, final, dof = _rescaled(ordered, scatter.points, known)
    evidence = weigh(finished, final, ordered.free, image_size, dof)
    cov = covariance(finished, ordered.free) * evidence.variance_factor
    status, advice = _judge(finished, cov, image_size)
    bundle = Bundle(finished.bundle.intrinsics, facing(finished.bundle.poses))
    return CalibratedViews(
        focal=bundle.intrinsics[:2],
        centre=bundle.intrinsics[2:4],
        distortion=bundle.intrinsics[4:],
        poses=bundle.poses,
        cov=cov,
        points_px=final.image,
        residuals_px=residuals_px(bundle, final),
        view=final.view,
        index=final.index,
        used=final.used,
        names=final.names,
        sigma_px=final.sigma,
        free=tuple(bool(one) for one in ordered.free),
        chi2_dof=1.0 if sigmas is None else _scale2(final, points),
        candidates=ordered.candidates,
        evidence=evidence,
        status=status,
        notes=(*gathered.notes, *advice, *_remarks(scatter, evidence, ordered)),
        outliers=(*outliers, *_listed(final)),
        iterations=full.iterations,
        starts_agreeing=agree,
        image_size=image_size,
    )


def _settled(
    points: Points,
    image_size: tuple[int, int],
    start: Geometry | None,
    start_poses: Float[np.ndarray, "views 6"] | None,
    prior: Prior,
) -> tuple[Solved, Points, int]:
    poses = None if start_poses is None else np.asarray(start_poses, dtype=np.float64)[list(points.names)]
    return settle(starts(points, image_size, _vector(start), poses), points, prior)


def _whole_views(points: Points, views: Bool[np.ndarray, " views"]) -> Outliers:
    names = tuple(f"view {points.names[k]}" for k in np.flatnonzero(views))
    return Outliers(STRANGE_RULE, int(views[points.view].sum()), names[:_MOST_PLACES])


def _check(gathered: Gathered, given: int, wanted: int) -> None:
    if len(gathered.points.names) < wanted:
        raise FitError(
            f"Expected at least {wanted} views of at least {MIN_POINTS} points each, found {given} views, "
            f"{len(gathered.points.names)} of them usable. {' '.join(gathered.notes)} Capture more views of the board."
        )


def _vector(start: Geometry | None) -> Float[np.ndarray, "9"] | None:
    if start is None:
        return None
    parts = (start.focal, start.centre, start.distortion)
    return np.concatenate([np.asarray(part, dtype=np.float64) for part in parts])


def _rescaled(ordered: Ordered, points: Points, prior: Prior) -> tuple[Solved, Points, float]:
    """The chosen order with the scale of its own residuals, and the degrees of freedom behind that."""
    solved = ordered.solved
    use = points.used
    dof = float((2 - leverages(solved, points, ordered.free))[use].sum())
    square = ((residuals_px(solved.bundle, points) / points.sigma[:, None])[use] ** 2).sum()
    factor = max(np.sqrt(square / max(dof, 1.0)), least_scale(points))
    points = points.scaled(np.full(len(points.names), factor))
    return solve(solved.bundle, points, ordered.free, prior), points, max(dof, 1.0)


def _scale2(points: Points, given: Points) -> float:
    return float(((points.sigma / given.sigma)[points.used] ** 2).mean())


def _judge(
    solved: Solved, cov: Float[np.ndarray, "n n"], image_size: tuple[int, int]
) -> tuple[FitStatus, tuple[str, ...]]:
    """Whether the views tell the lens; else what to capture."""
    sigma = np.sqrt(np.diag(cov))
    by_focal = float((sigma[:2] / np.abs(solved.bundle.intrinsics[:2])).max())
    by_centre = float(sigma[2:4].max() / image_size[0])
    if by_focal > MOST_UNCERTAIN or by_centre > MOST_UNCERTAIN:
        what = "focal length" if by_focal > by_centre else "centre of the picture"
        return FitStatus.TOO_FEW_DATA, (
            f"The views do not tell the {what} (one sigma is {min(max(by_focal, by_centre), 99.0):.0%}). "
            "Lean the board by 20 to 40 degrees, another way in each view, and let it fill the picture.",
        )
    if not solved.converged:
        return FitStatus.NOT_CONVERGED, ("Check that the points of each view are in the order of the board's.",)
    return FitStatus.CONVERGED, ()


def _remarks(scatter: Scatter, evidence: Evidence, ordered: Ordered) -> tuple[str, ...]:
    notes = []
    if ordered.by_prior:
        notes.append(
            "The views alone do not tell the whole lens: what is known beforehand stands for part of it, and every "
            "distortion coefficient stays free within that. Lean the board another way in each view to know more."
        )
    relative = scatter.scales / np.median(scatter.scales)
    loud = [f"{scatter.points.names[k]} ({relative[k]:.1f} x)" for k in np.flatnonzero(relative > _SCATTERS_MORE)]
    if loud:
        notes.append(f"Views that scatter more than the median view, and count for less: {', '.join(loud)}.")
    if evidence.views.flagged:
        notes.append(
            f"The views disagree on the lens beyond their noise (ratio {evidence.views.ratio:.1f}, "
            f"p = {evidence.views.p_value:.1g}): every variance is multiplied by that ratio. Is the board flat?"
        )
    if evidence.pattern.flagged:
        notes.append(
            f"The residuals follow a pattern over the picture (p = {evidence.pattern.p_value:.1g}, about "
            f"{evidence.pattern_px:.3f} px): the lens bends rays in a way that no order has."
        )
    return tuple(notes)


def _listed(points: Points) -> tuple[Outliers, ...]:
    out = np.flatnonzero(~points.used)
    if not len(out):
        return ()
    return (Outliers(OUTLIER_RULE, len(out), tuple(points.place(int(k)) for k in out[:_MOST_PLACES])),)
