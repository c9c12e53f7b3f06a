"""Geometry fit: views of a ChArUco board through the panel -> intrinsics, distortion, and the camera's tilt.

One view shows the board parallel to the panel. Its axes are then the panel's, so that the inverse of its pose is
``R_panel_camera``. Stand-off and panel position stay nominal here: a far board does not show them; the wire fit does.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udccal.errors import FitError
from udccal.fitting.geometry.angles import ANGLE_NAMES, panel_rotation, with_angles
from udccal.fitting.geometry.bundle import MIN_VIEWS, calibrate_views
from udccal.fitting.geometry.bundle_orders import INTRINSIC_NAMES
from udccal.fitting.geometry.bundle_points import bucket
from udccal.fitting.geometry.bundle_solve import Prior
from udccal.fitting.geometry.calibrated_views import CalibratedViews
from udccal.fitting.geometry.corner_scatter import CornerScatter, excess_scatter
from udccal.fitting.geometry.corners import MIN_CORNERS, board_points_mm
from udccal.fitting.geometry.report import (
    PATTERN,
    diagnostics_of,
    held_notes,
    outliers_of,
    rejections,
    residual_sample,
)
from udccal.fitting.geometry.views import MAX_CLIPPED, BoardView, read_views
from udccal.fitting.nominal import nominal_geometry
from udccal.models.geometry import Geometry, mounting_rotation, panel_directions, project
from udccal.models.noise import Noise
from udccal.numerics import in_float64
from udccal.result import Estimate, FitResult, FitStatus
from udccal.rig import RigDescription
from udccal.sessions.store import Session

__all__ = ["BoardView", "fit_geometry", "fit_views", "projection_sigma_px", "read_views", "rig_prior"]

_WORST_RMS_PX, _WORST_CHI2_DOF = 1.0, 9.0
# Corners' scatter beside noise: where its estimate starts, and the change that ends it (relatively).
_START_SCATTER_PX, _SETTLED, _SCATTER_ROUNDS = 0.02, 0.05, 4
# Lenses sit on their sensors' middles to about this part of the width (one sigma).
_CENTRE_SIGMA = 0.01
# (k1, k2, p1, p2, k3) of lenses that this model describes.
_BEND_SIGMA = (0.2, 0.2, 1e-3, 1e-3, 0.1)
UNITS = ("px", "px", "px", "px", "1", "1", "1", "1", "1", "deg", "deg", "deg")


def fit_geometry(session: Session, noise: Noise) -> FitResult[Geometry]:
    """Fit the geometry term to the steps ``geometry/*`` of a session.

    What the rig's description says of the lens is the prior: where the views do not tell the focal length, it stays
    nominal with the sigma of its tolerance.

    Args:
        session: holds views of a board, one of them ``parallel_to_panel``.
        noise: gives the black level and saturation.

    Raises:
        SessionError: when a file is missing or damaged.
    """
    rig = session.rig
    size = (rig.camera.columns, rig.camera.rows)
    return fit_views(read_views(session, noise), nominal_geometry(rig), size, rig_prior(rig))


def rig_prior(rig: RigDescription) -> Prior:
    """What a rig's description says of its lens: the focal length by its tolerance, the rest as lenses commonly are."""
    nominal = nominal_geometry(rig)
    sigma = np.array([0.0, 0.0, 0.0, 0.0, *_BEND_SIGMA])
    sigma[:2] = rig.focal_px * max(rig.lens.focal_mm.tolerance / rig.lens.focal_mm.value, 1e-4)
    sigma[2:4] = _CENTRE_SIGMA * rig.camera.columns
    return Prior(np.concatenate([nominal.focal, nominal.centre, nominal.distortion]), 1 / sigma**2)


def fit_views(
    views: Sequence[BoardView], nominal: Geometry, image_size: tuple[int, int], prior: Prior | None = None
) -> FitResult[Geometry]:
    """Fit the geometry term to boards already found.

    Args:
        views: boards, one of them parallel to the panel; at least 3 usable ones, or any number with a prior.
        nominal: where to start; its pupil is kept.
        image_size: (columns, rows).
        prior: on the intrinsics, such as ``rig_prior`` gives.
    """
    usable = [view for view in views if view.usable]
    notes = _notes(views)
    wanted = MIN_VIEWS if prior is None else 1
    parallel = sum(view.parallel for view in usable)
    if len(usable) < wanted or not parallel:
        clipped = sum(view.clipped > MAX_CLIPPED for view in views)
        status = FitStatus.SATURATED if clipped > len(views) / 2 else FitStatus.TOO_FEW_DATA
        found = f"Expected {wanted} views with a board and one of them parallel to the panel, found {len(usable)} "
        return _failed(nominal, status, (*notes, f"{found}and {parallel}."))
    try:
        bundle, scatter = _calibrated(usable, nominal, image_size, prior)
    except FitError as error:
        return _failed(nominal, FitStatus.TOO_FEW_DATA, (*notes, str(error)))
    return _result(bundle, scatter, [usable[k] for k in bundle.names], nominal, (*notes, *bundle.notes))


def _calibrated(
    views: Sequence[BoardView], nominal: Geometry, image_size: tuple[int, int], prior: Prior | None
) -> tuple[CalibratedViews, CornerScatter]:
    """The bundle; every corner has its noise and the scatter that all have beside it, estimated with the rest."""
    scatter = CornerScatter(_START_SCATTER_PX)
    points = [board_points_mm(view.spec)[view.corners.ids] for view in views]
    seen = [view.corners.xy for view in views]
    for _ in range(_SCATTER_ROUNDS):
        sigmas = [scatter.of(view.corners.sigma) for view in views]
        bundle = calibrate_views(points, seen, image_size, nominal, sigmas, prior=prior)
        noise_px = [views[bundle.names[v]].corners.sigma[k] for v, k in zip(bundle.view, bundle.index, strict=True)]
        before, scatter = scatter, excess_scatter(bundle, np.array(noise_px))
        if abs(scatter.excess_px - before.excess_px) <= _SETTLED * before.excess_px:
            break
    return bundle, scatter


def _notes(views: Sequence[BoardView]) -> tuple[str, ...]:
    lost = [view.step_id for view in views if len(view.corners.ids) < MIN_CORNERS]
    clipped = [view.step_id for view in views if view.clipped > MAX_CLIPPED]
    notes = []
    if lost:
        notes.append(f"No board (fewer than {MIN_CORNERS} corners) in {', '.join(lost)}.")
    if clipped:
        notes.append(f"More than {MAX_CLIPPED:.0%} of the samples clipped in {', '.join(clipped)}.")
    return tuple(notes)


def _failed(nominal: Geometry, status: FitStatus, notes: tuple[str, ...]) -> FitResult[Geometry]:
    return FitResult.failed("geometry", nominal, status, *notes)


def _result(
    bundle: CalibratedViews,
    scatter: CornerScatter,
    views: list[BoardView],
    nominal: Geometry,
    notes: tuple[str, ...],
) -> FitResult[Geometry]:
    """``views`` are those that the bundle uses."""
    parallel = [k for k, view in enumerate(views) if view.parallel]
    if bundle.status is FitStatus.TOO_FEW_DATA or not parallel:
        lost = () if parallel else ("No usable view shows the board parallel to the panel; capture that view again.",)
        return _failed(nominal, FitStatus.TOO_FEW_DATA, (*notes, *lost))
    rotation = panel_rotation(bundle, parallel)
    pupil = np.asarray(nominal.pupil, dtype=np.float64)
    values, cov = with_angles(bundle, parallel, rotation)
    sigma = np.sqrt(np.maximum(np.diag(cov), 0.0))
    names = INTRINSIC_NAMES + ANGLE_NAMES
    return FitResult(
        name="geometry",
        term=Geometry(bundle.focal, bundle.centre, bundle.distortion, rotation, pupil),
        status=FitStatus.POOR_FIT if _poor(bundle) else bundle.status,
        estimates=tuple(
            Estimate(name, float(value), float(one), unit)
            for name, value, one, unit in zip(names, values, sigma, UNITS, strict=True)
        ),
        cov=cov,
        chi2_dof=bundle.chi2_dof,
        samples=2 * int(bundle.used.sum()),
        candidates=bundle.candidates,
        diagnostics=diagnostics_of(bundle, scatter, views),
        notes=(*notes, *rejections(bundle, views), *held_notes(bundle)),
        outliers=outliers_of(bundle, views),
        residuals=residual_sample(bundle),
    )


def _poor(bundle: CalibratedViews) -> bool:
    """Far off in pixels, and far more so than the corners' own sigma allows."""
    return bundle.rms_px > _WORST_RMS_PX and bundle.chi2_dof > _WORST_CHI2_DOF


@in_float64
def projection_sigma_px(result: FitResult[Geometry], pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """One sigma in px (x, y) of where directions fixed in panel coordinates appear, at the sensor pixels given.

    What the residuals show of the model's own error is part of it. Zero everywhere when the fit failed and has no
    covariance.
    """
    if not len(result.cov):
        return np.zeros((len(pixels), 2))
    padded = np.tile(np.asarray(result.term.centre, dtype=np.float64), (bucket(len(pixels)), 1))
    padded[: len(pixels)] = pixels
    directions = np.asarray(_directions(result.term, padded))
    slopes = np.asarray(_slopes(np.array([e.value for e in result.estimates]), directions))[: len(pixels)]
    variance = np.maximum(np.einsum("nip,pq,niq->ni", slopes, result.cov, slopes), 0.0)
    pattern = next((d.value for d in result.diagnostics if d.name == PATTERN), 0.0)
    return np.sqrt(variance + pattern**2)


_directions = jax.jit(panel_directions)


@jax.jit
def _slopes(parameters: Float[Array, "12"], directions: Float[Array, "n 3"]) -> Float[Array, "n 2 12"]:
    def seen(x: Float[Array, "12"]) -> Float[Array, "n 2"]:
        camera = Geometry(x[:2], x[2:4], x[4:9], jnp.zeros(3), jnp.zeros(3))
        tilt, roll, yaw = jnp.deg2rad(x[9:])
        return project(camera, directions @ mounting_rotation(tilt, roll, yaw))

    return jax.jacfwd(seen)(parameters)
