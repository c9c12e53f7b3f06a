"""Geometry fit: views of a ChArUco board through the panel -> intrinsics, distortion, and the camera's tilt.

One view shows the board parallel to the panel. Its axes are then the panel's, so that the inverse of its pose is
``R_panel_camera``. Stand-off and panel position stay nominal here: a far board does not show them; the wire fit does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.spatial.transform import Rotation

from udccal.arrangements import BoardSpec
from udccal.fitting.bundle import INTRINSIC_NAMES, OUTLIER_SIGMA, CalibratedViews, calibrate_views
from udccal.fitting.corners import MIN_CORNERS, BoardCorners, board_points_mm, detect_corners, luminance
from udccal.fitting.nominal import nominal_geometry
from udccal.fitting.result import Diagnostic, Estimate, FitResult, FitStatus
from udccal.models.arrays import Arrayish
from udccal.models.geometry import (
    Geometry,
    mounting_rotation,
    panel_directions,
    project,
    rotation_matrix,
)
from udccal.models.noise import Noise
from udccal.numerics import in_float64
from udccal.sessions.schema import BoardSubject, StoredStep
from udccal.sessions.store import Session

_MIN_VIEWS = 3
# A view with more of its samples than this at saturation has bloomed edges.
_MAX_CLIPPED = 0.02
_WORST_RMS_PX = 1.0
ANGLE_NAMES = ("tilt_deg", "roll_deg", "yaw_deg")
UNITS = ("px", "px", "px", "px", "1", "1", "1", "1", "1", "deg", "deg", "deg")


@dataclass(frozen=True)
class BoardView:
    """The corners of one step's board."""

    step_id: str
    spec: BoardSpec
    parallel: bool
    corners: BoardCorners
    clipped: float

    @property
    def usable(self) -> bool:
        """Whether enough corners were found in an unclipped picture."""
        return len(self.corners.ids) >= MIN_CORNERS and self.clipped <= _MAX_CLIPPED


def fit_geometry(session: Session, noise: Noise) -> FitResult[Geometry]:
    """Fit the geometry term to the steps ``geometry/*`` of a session.

    Args:
        session: holds views of a board, at least 3, and one of them ``parallel_to_panel``.
        noise: gives the black level and saturation.

    Raises:
        SessionError: when a file is missing or damaged.
    """
    camera = session.rig.camera
    return fit_views(read_views(session, noise), nominal_geometry(session.rig), (camera.columns, camera.rows))


def read_views(session: Session, noise: Noise) -> tuple[BoardView, ...]:
    """The boards of all steps ``geometry/*``; arguments and errors as for ``fit_geometry``."""
    steps = [step for step in session.steps("geometry") if isinstance(step.subject, BoardSubject)]
    return tuple(_read_view(session, step, noise) for step in steps)


def _read_view(session: Session, step: StoredStep, noise: Noise) -> BoardView:
    """Find the board in the first capture of a step (its average, or a single frame)."""
    subject, capture = step.subject, step.captures[0]
    if not isinstance(subject, BoardSubject):
        raise TypeError(f"step {step.id} shows no board")
    mean = session.frame(capture) if capture.kind == "frame" else session.average(capture).mean
    spec = BoardSpec(subject.columns, subject.rows, subject.square_mm, subject.marker_mm, subject.dictionary)
    corners = detect_corners(luminance(mean.astype(np.float64) - float(np.asarray(noise.black_DN))), spec)
    shift = np.array([capture.region.x, capture.region.y], dtype=np.float64)
    moved = BoardCorners(corners.ids, corners.xy + shift, corners.sigma)
    clipped = float(np.mean(mean >= 0.995 * float(np.asarray(noise.saturation_DN))))
    return BoardView(step.id, spec, subject.parallel_to_panel, moved, clipped)


def fit_views(views: Sequence[BoardView], nominal: Geometry, image_size: tuple[int, int]) -> FitResult[Geometry]:
    """Fit the geometry term to boards already found; ``image_size`` is (columns, rows)."""
    usable = [view for view in views if view.usable]
    notes = _notes(views)
    parallel = [k for k, view in enumerate(usable) if view.parallel]
    if len(usable) < _MIN_VIEWS or not parallel:
        clipped = sum(view.clipped > _MAX_CLIPPED for view in views)
        status = FitStatus.SATURATED if clipped > len(views) / 2 else FitStatus.TOO_FEW_DATA
        found = f"Expected {_MIN_VIEWS} views with a board and one of them parallel to the panel, found {len(usable)} "
        return _failed(nominal, status, (*notes, f"{found}and {len(parallel)}."))
    bundle = calibrate_views(
        [board_points_mm(view.spec)[view.corners.ids] for view in usable],
        [view.corners.xy for view in usable],
        image_size,
        nominal,
        [view.corners.sigma for view in usable],
    )
    return _result(bundle, usable, parallel, nominal, notes)


def _notes(views: Sequence[BoardView]) -> tuple[str, ...]:
    lost = [view.step_id for view in views if len(view.corners.ids) < MIN_CORNERS]
    clipped = [view.step_id for view in views if view.clipped > _MAX_CLIPPED]
    notes = []
    if lost:
        notes.append(f"No board (fewer than {MIN_CORNERS} corners) in {', '.join(lost)}.")
    if clipped:
        notes.append(f"More than {_MAX_CLIPPED:.0%} of the samples clipped in {', '.join(clipped)}.")
    return tuple(notes)


def _failed(nominal: Geometry, status: FitStatus, notes: tuple[str, ...]) -> FitResult[Geometry]:
    return FitResult(
        term=nominal, status=status, estimates=(), cov=np.zeros((0, 0)), chi2_dof=0.0, samples=0, notes=notes
    )


def _result(
    bundle: CalibratedViews, views: list[BoardView], parallel: list[int], nominal: Geometry, notes: tuple[str, ...]
) -> FitResult[Geometry]:
    mean = Rotation.from_rotvec(-bundle.poses[parallel, :3]).mean()
    rotation = np.asarray(mean.as_rotvec(), dtype=np.float64)
    term = Geometry(
        focal=bundle.focal,
        centre=bundle.centre,
        distortion=bundle.distortion,
        rotation=rotation,
        pupil=np.asarray(nominal.pupil, dtype=np.float64),
    )
    values, cov = _with_angles(bundle, parallel, rotation)
    sigma = np.sqrt(np.maximum(np.diag(cov), 0.0))
    names = INTRINSIC_NAMES + ANGLE_NAMES
    estimates = tuple(
        Estimate(name, float(value), float(one), unit)
        for name, value, one, unit in zip(names, values, sigma, UNITS, strict=True)
    )
    status = FitStatus.CONVERGED if bundle.converged else FitStatus.NOT_CONVERGED
    if bundle.rms_px > _WORST_RMS_PX:
        status = FitStatus.POOR_FIT
    return FitResult(
        term=term,
        status=status,
        estimates=estimates,
        cov=cov,
        chi2_dof=bundle.chi2_dof,
        samples=2 * int(bundle.used.sum()),
        candidates=bundle.candidates,
        diagnostics=_diagnostics(bundle, views),
        notes=(*notes, *_rejections(bundle, views), *_held(bundle)),
    )


def _diagnostics(bundle: CalibratedViews, views: list[BoardView]) -> tuple[Diagnostic, ...]:
    return (
        Diagnostic("rms_reprojection", bundle.rms_px, "px"),
        Diagnostic("views", float(len(views)), "1"),
        Diagnostic("corners_used", float(bundle.used.sum()), "1"),
        Diagnostic("corners_rejected", float((~bundle.used).sum()), "1"),
        Diagnostic("iterations", float(bundle.iterations), "1"),
    )


def _rejections(bundle: CalibratedViews, views: list[BoardView]) -> tuple[str, ...]:
    """One sentence per view that lost corners."""
    ids = np.concatenate([view.corners.ids for view in views])
    notes = []
    for index, view in enumerate(views):
        out = ids[(bundle.view == index) & ~bundle.used]
        if len(out):
            listed = ", ".join(map(str, out))
            notes.append(f"{view.step_id}: corners {listed} left out, off by more than {OUTLIER_SIGMA:g} robust sigma.")
    return tuple(notes)


def _held(bundle: CalibratedViews) -> tuple[str, ...]:
    held = [name for name, free in zip(INTRINSIC_NAMES, bundle.free, strict=True) if not free]
    fixed = (f"Held at 0, as the data do not ask for it: {', '.join(held)}.",) if held else ()
    return (*fixed, "Stand-off and panel position are the rig's nominal ones; the wire fit refines them.")


def _angles_deg(rotation: Float[Arrayish, "3"]) -> Float[Array, "3"]:
    """(tilt, roll, yaw) of R_panel_camera = Ry(yaw) Rx(-tilt) Rz(roll)."""
    r = rotation_matrix(rotation)
    tilt, roll, yaw = jnp.arcsin(r[1, 2]), jnp.arctan2(r[1, 0], r[1, 1]), jnp.arctan2(r[0, 2], r[2, 2])
    return jnp.rad2deg(jnp.stack([tilt, roll, yaw]))


_angles, _angle_slopes = jax.jit(_angles_deg), jax.jit(jax.jacfwd(_angles_deg))


@in_float64
def _with_angles(
    bundle: CalibratedViews, parallel: list[int], rotation: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "12"], Float[np.ndarray, "12 12"]]:
    """Values and covariance of intrinsics and angles; several parallel views count as their mean."""
    slope = np.asarray(_angle_slopes(rotation))
    picks = np.zeros((12, len(bundle.cov)))
    picks[:9, :9] = np.eye(9)
    for view in parallel:
        picks[9:, 9 + 6 * view : 12 + 6 * view] = -slope / len(parallel)
    angles = np.asarray(_angles(rotation), dtype=np.float64)
    values = np.concatenate([bundle.focal, bundle.centre, bundle.distortion, angles])
    return values, picks @ bundle.cov @ picks.T


@in_float64
def projection_sigma_px(result: FitResult[Geometry], pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """One sigma in px (x, y) of where directions fixed in panel coordinates appear, at the sensor pixels given.

    Zero everywhere when the fit failed and has no covariance.
    """
    if not len(result.cov):
        return np.zeros((len(pixels), 2))
    term = result.term
    parameters = np.array([e.value for e in result.estimates])
    directions = panel_directions(term, pixels)

    def seen(x: Float[Array, "12"]) -> Float[Array, "n 2"]:
        camera = Geometry(x[:2], x[2:4], x[4:9], jnp.zeros(3), jnp.zeros(3))
        tilt, roll, yaw = jnp.deg2rad(x[9:])
        return project(camera, directions @ mounting_rotation(tilt, roll, yaw))

    jacobian = np.asarray(jax.jacfwd(seen)(jnp.asarray(parameters)), dtype=np.float64)
    return np.sqrt(np.maximum(np.einsum("nip,pq,niq->ni", jacobian, result.cov, jacobian), 0.0))
