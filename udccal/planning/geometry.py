"""Prediction for geometry: the bundle of the boards that the procedure asks for, and the sigma of rays to the panel.

A planned view holds the corners that it would show, with their scatter. The fit's own equations give the covariance of
intrinsics and poses. The pose of the board on the jig gives the panel's rotation.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import final

import jax
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation
from scipy.special import erf

from udccal.arrangements import Board
from udccal.fitting.engine.gaussian import Posterior, scaled_inverse
from udccal.fitting.engine.orders import bic
from udccal.fitting.geometry.bundle import (
    EVERY,
    ORDERS,
    Bundle,
    BundleProblem,
    GeometryRules,
    Intrinsics,
    Points,
    projected,
)
from udccal.fitting.geometry.corners import board_points_mm, charuco_board
from udccal.fitting.geometry.data import rig_prior
from udccal.fitting.geometry.fit import term_at, with_angles
from udccal.models.geometry import panel_directions, project_directions
from udccal.numerics import in_float64
from udccal.planning.design import Floor
from udccal.planning.state import WHITE, EvenField, RigState, sample_variance_e, sensor_samples
from udccal.planning.steps import PlannedStep, planned_steps
from udccal.rig import Captures

_ACROSS = 17
# Stands for endless views.
_MANY = 1e6
# Scatter of corners by axis in addition to noise, where no profile has measured it. Edges of the board on the jig run
# along the sensor's rows: samples see them at few phases, and corners scatter more than on boards that lean.
_ON_JIG_PX, _BY_HAND_PX = 0.0085, 0.006
# White paper reflects so much more than black ink that half the difference is this part of white.
_HALF_CONTRAST = 0.47
# Edges after lens, pixel and the filter that makes a grey picture of a mosaic (one sigma).
_EDGE_PX = 1.0
# Radius of a saddle's window in squares: markers lie outside it.
_WINDOW_SQUARES = 0.16
_RULES = GeometryRules()
_places, _directions = jax.jit(project_directions), jax.jit(panel_directions)


@final
@dataclass(frozen=True)
class _View:
    """Corners that a planned view would show (on the board, in px, with scatter), and its pose, board to camera."""

    board: Float[np.ndarray, "n 3"]
    image: Float[np.ndarray, "n 2"]
    sigma: Float[np.ndarray, " n"]
    pose: Float[np.ndarray, "6"]
    parallel: bool


@final
class GeometryPredictor:
    """Predicts the sigma in px, by axis, of where rays fixed to the panel land."""

    def __init__(self, state: RigState) -> None:
        self._state = state
        self._field = EvenField(state)
        self._intrinsics = Intrinsics.of_geometry(state.geometry).vector
        self._prior = rig_prior(state.rig)
        self._known: dict[Board, _View | None] = {}

    def sigma(self, captures: Captures) -> float:
        """Root mean square over the sensor and both axes; see ``Predictor``."""
        return self._ray_sigma(self._views(captures), 1.0)

    def floor(self) -> Floor:
        """The sigma when endless views held by hand have determined the lens."""
        return Floor(
            self._ray_sigma(self._views(self._state.rig.captures), _MANY),
            "The panel's rotation rests on the one view of the board on the jig: a larger or nearer board there, or "
            "corners that scatter less, would lower that.",
        )

    def used(self, captures: Captures) -> float:
        """1, since the fit uses all corners; see ``Predictor``."""
        return 1.0

    def _views(self, captures: Captures) -> list[_View]:
        views = []
        for step in planned_steps("geometry", self._state.with_captures(captures)):
            if isinstance(board := step.arrangement, Board):
                if board not in self._known:
                    self._known[board] = _planned_view(self._state, self._field, step, board)
                views.append(self._known[board])
        return [view for view in views if view is not None]

    @in_float64
    def _ray_sigma(self, views: list[_View], count: float) -> float:
        """Sigma in px of rays, by axis, where each view held by hand counts ``count`` times."""
        parallel = [k for k, view in enumerate(views) if view.parallel]
        if not parallel:
            return float("inf")
        sizes = [len(view.sigma) for view in views]
        points = Points(
            board=np.concatenate([view.board for view in views]),
            image=np.concatenate([view.image for view in views]),
            sigma=np.concatenate([view.sigma for view in views]),
            view=np.repeat(np.arange(len(views)), sizes),
            index=np.concatenate([np.arange(size) for size in sizes]),
            used=np.ones(sum(sizes), dtype=bool),
            names=tuple(range(len(views))),
        ).scaled(np.array([1.0 if view.parallel else count**-0.5 for view in views]))
        bundle = Bundle(self._intrinsics, np.array([view.pose for view in views]))
        free = self._order(points, bundle)
        cov = BundleProblem(points, free, self._prior).equations_at(bundle).joint_cov()
        x, cov = with_angles(bundle.intrinsics, bundle.poses, cov, parallel)
        posterior = Posterior.from_cov(x, cov, partial(term_at, pupil=np.asarray(self._state.geometry.pupil_mm)))
        directions = np.asarray(_directions(posterior.term_at(x), sensor_samples(self._state.rig, _ACROSS)))
        sigma = posterior.sigma_of(lambda term: np.asarray(_places(term, directions)))
        return float(np.sqrt((sigma**2).mean()))

    def _order(self, points: Points, bundle: Bundle) -> Bool[np.ndarray, "9"]:
        """The order of the distortion that the fit is expected to choose, by its own BIC, n ln(chi2) + k ln(n)."""
        equations = BundleProblem(points, EVERY, self._prior).equations_at(bundle)
        cov, samples = equations.cov(), equations.samples
        freedom = max(samples - EVERY.sum() - bundle.poses.size, 1)

        def criterion(free: Bool[np.ndarray, "9"]) -> float:
            held = self._intrinsics * ~free
            rise = float(held @ scaled_inverse(cov * np.outer(~free, ~free)) @ held)
            return bic(samples * float(np.log1p(rise / freedom)), float(free.sum()), samples)

        return min(ORDERS.values(), key=criterion)


def _planned_view(state: RigState, field: EvenField, step: PlannedStep, board: Board) -> _View | None:
    """None where the board shows too few corners to hold its pose."""
    to_camera = Rotation.from_rotvec(np.asarray(state.geometry.rotation_rad)).inv()
    rotation = to_camera * Rotation.from_rotvec(np.array(board.rotation_vector))
    origin = to_camera.apply(np.array(board.translation_mm) - np.asarray(state.geometry.pupil_mm))
    intrinsics, corners = Intrinsics.of_geometry(state.geometry).vector, board_points_mm(board.spec)
    markers = np.asarray(charuco_board(board.spec).getObjPoints(), dtype=np.float64).reshape(-1, 3)
    image, marks = (projected(intrinsics, rotation.apply(points) + origin)[0] for points in (corners, markers))
    depth = float((rotation.apply(corners.mean(axis=0)) + origin)[2])
    square_px = board.spec.square_mm / depth * Intrinsics.of(intrinsics).focal_px[0]
    radius = float(np.clip(_WINDOW_SQUARES * square_px, *_RULES.window_px))
    whole = _inside(state, marks, 1.0).reshape(-1, 4).all(axis=1)
    # Only corners with both markers in the picture count: without these the detector does not know their numbers.
    near = np.linalg.norm(corners[:, None] - markers.reshape(-1, 4, 3).mean(axis=1), axis=2) < board.spec.square_mm
    good = _inside(state, image, np.ceil(radius) + 1) & ~(near & ~whole).any(axis=1)
    if depth <= 0 or good.sum() < _RULES.least_corners:
        return None
    known, common = (
        (state.model_errors.on_jig_px, _ON_JIG_PX)
        if board.parallel_to_panel
        else (state.model_errors.by_hand_px, _BY_HAND_PX)
    )
    sigma = np.hypot(_noise_px(state, field, step, image[good], radius), common if known is None else known)
    pose = np.concatenate([rotation.as_rotvec(), origin])
    return _View(corners[good], image[good], sigma, pose, board.parallel_to_panel)


def _noise_px(
    state: RigState, field: EvenField, step: PlannedStep, pixels: Float[np.ndarray, "n 2"], radius: float
) -> Float[np.ndarray, " n"]:
    """Scatter of saddles by temporal noise of the board's frames; that of the flat field, of far more, is left out."""
    white = (step.level or 0.0) * state.full_well_e * field.at(pixels)
    signal = white[:, None] * np.array(WHITE)[[0, 1, 1, 2]] / max(WHITE)
    temporal = sample_variance_e(state, 0.5 * signal, step.exposures_s[0]) / len(step.exposures_s)
    relative = temporal / signal**2
    return np.asarray(np.sqrt(relative.mean(axis=1)) / _HALF_CONTRAST * _saddle_scatter(radius))


def _saddle_scatter(radius_px: float) -> float:
    """Scatter by axis in px of a weighted fit of erf(x) erf(y) with a free slope, at unit noise over contrast."""
    half = int(np.ceil(radius_px))
    y, x = np.mgrid[-half : half + 1, -half : half + 1].astype(np.float64) / _EDGE_PX
    weight = np.clip(1 - (x**2 + y**2) * (_EDGE_PX / radius_px) ** 2, 0.0, None).ravel()
    across = np.sqrt(2 / np.pi) / _EDGE_PX * np.exp(-0.5 * x**2) * erf(y / np.sqrt(2))
    design = np.stack([across.ravel(), y.ravel()], axis=1)
    # The window's weights are not those of the noise: the covariance is a sandwich.
    solved = np.linalg.solve(design.T @ (design * weight[:, None]), (design * weight[:, None]).T)
    return float(np.linalg.norm(solved[0]))


def _inside(state: RigState, pixels: Float[np.ndarray, "n 2"], margin: float) -> Bool[np.ndarray, " n"]:
    last = np.array([state.rig.camera.columns, state.rig.camera.rows]) - 1 - margin
    return np.asarray(np.all((pixels >= margin) & (pixels <= last), axis=1))
