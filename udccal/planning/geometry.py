"""Planning for geometry: views of boards, what they tell about rays to the panel, and which view to take next.

A planned view holds the corners that it would show, with their scatter. The fit's own equations give the covariance of
intrinsics and poses. The pose of the board on the jig gives the panel's rotation.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation
from scipy.special import erf

from udccal.arrangements import Board, BoardSpec
from udccal.board.charuco import board_points_mm, charuco_board
from udccal.fitting.engine.gaussian import Posterior, scaled_inverse
from udccal.fitting.engine.orders import bic
from udccal.fitting.geometry.bundle import (
    EVERY,
    ORDERS,
    RULES,
    Bundle,
    BundleProblem,
    Intrinsics,
    Points,
    projected,
)
from udccal.fitting.geometry.data import best_poses, gather, rig_prior
from udccal.fitting.geometry.fit import projection_sigma_px, term_at, with_angles
from udccal.numerics import in_float64
from udccal.planning.design import Limits
from udccal.planning.state import WHITE, EvenField, RigState, nominal_state, sensor_samples
from udccal.planning.steps import PlannedStep
from udccal.rig import Captures, RigDescription

# White paper reflects so much more than black ink that half the difference is this part of white.
_HALF_CONTRAST = 0.47
# Edges after lens, pixel and the filter that makes a grey picture of a mosaic (one sigma).
_EDGE_PX = 1.0
# Radius of a saddle's window in squares: markers lie outside it.
_WINDOW_SQUARES = 0.16
# Rays are looked at in so many places along each side of the sensor.
_ACROSS = 17
# Stands for endless views.
_MANY = 1e6


@final
@dataclass(frozen=True)
class BoardView:
    """Corners of one view (on the board, in px, with scatter), and its pose, board to camera."""

    board: Float[np.ndarray, "n 3"]
    image: Float[np.ndarray, "n 2"]
    sigma: Float[np.ndarray, " n"]
    pose: Float[np.ndarray, "6"]
    parallel: bool


@final
class BoardViews:
    """Makes the views of one rig's boards."""

    def __init__(self, state: RigState) -> None:
        self._state, self._field = state, EvenField(state)
        self.intrinsics = Intrinsics.of_geometry(state.geometry).vector

    def planned(self, step: PlannedStep, board: Board) -> BoardView | None:
        """Return the view of a board in the light of a step; None where it shows too few corners to hold its pose."""
        geometry, spec = self._state.geometry, board.spec
        to_camera = Rotation.from_rotvec(np.asarray(geometry.rotation_rad)).inv()
        rotation = to_camera * Rotation.from_rotvec(np.array(board.rotation_vector))
        origin = to_camera.apply(np.array(board.translation_mm) - np.asarray(geometry.pupil_mm))
        corners = board_points_mm(spec)
        markers = np.asarray(charuco_board(spec).getObjPoints(), dtype=np.float64).reshape(-1, 3)
        image, marks = (projected(self.intrinsics, rotation.apply(points) + origin)[0] for points in (corners, markers))
        depth = float((rotation.apply(corners.mean(axis=0)) + origin)[2])
        radius = self._window_px(spec, depth)
        whole = self._inside(marks, 1.0).reshape(-1, 4).all(axis=1)
        # Only corners with both markers in the picture count: without these the detector does not know their numbers.
        near = np.linalg.norm(corners[:, None] - markers.reshape(-1, 4, 3).mean(axis=1), axis=2) < spec.square_mm
        good = self._inside(image, np.ceil(radius) + 1) & ~(near & ~whole).any(axis=1)
        if depth <= 0 or good.sum() < RULES.least_corners:
            return None
        pose = np.append(rotation.as_rotvec(), origin)
        sigma = self._sigma_px(step, image[good], radius, board.parallel_to_panel)
        return BoardView(corners[good], image[good], sigma, pose, board.parallel_to_panel)

    def seen(
        self, step: PlannedStep, spec: BoardSpec, numbers: Int[np.ndarray, " n"], points_px: Float[np.ndarray, "n 2"]
    ) -> BoardView | None:
        """Return the view of corners that were found; None where they are too few to hold its pose.

        Args:
            step, spec: the light; the board, held by hand.
            numbers, points_px: of the corners, as OpenCV counts them; where they are on the sensor.
        """
        corners = board_points_mm(spec)[numbers]
        points = gather([corners], [points_px]).points
        if not points.names:
            return None
        pose = best_poses(points, self.intrinsics)[0][0]
        sigma = self._sigma_px(step, points_px, self._window_px(spec, float(pose[5])), parallel=False)
        return BoardView(corners, points_px, sigma, pose, parallel=False)

    def information(self, view: BoardView | None) -> Float[np.ndarray, "9 9"]:
        """Return the Fisher information of one view on the intrinsics, whatever its own pose; none without a pose."""
        size = len(self.intrinsics)
        if view is None or not (points := gather([view.board], [view.image], [view.sigma]).points).names:
            return np.zeros((size, size))
        return BundleProblem(points, EVERY).equations_at(Bundle(self.intrinsics, view.pose[None])).marginal()[0]

    def _window_px(self, spec: BoardSpec, depth_mm: float) -> float:
        square_px = spec.square_mm / depth_mm * float(np.asarray(self._state.geometry.focal_px)[0])
        return float(np.clip(_WINDOW_SQUARES * square_px, *RULES.window_px))

    def _inside(self, pixels: Float[np.ndarray, "n 2"], margin: float) -> Bool[np.ndarray, " n"]:
        last = np.array([self._state.rig.camera.columns, self._state.rig.camera.rows]) - 1 - margin
        return np.asarray(np.all((pixels >= margin) & (pixels <= last), axis=1))

    def _sigma_px(
        self, step: PlannedStep, pixels: Float[np.ndarray, "n 2"], radius: float, parallel: bool
    ) -> Float[np.ndarray, " n"]:
        """Scatter by noise of the board's frames and by all else; that of the flat field, of far more, is left out."""
        state, errors = self._state, self._state.model_errors
        signal = step.level * state.full_well_e * np.outer(self._field.at(pixels), WHITE[[0, 1, 1, 2]])
        temporal = state.variance_e(0.5 * signal, step.exposures_s[0]) / len(step.exposures_s)
        relative = np.sqrt((temporal / signal**2).mean(axis=1))
        beside_px = errors.on_jig_px if parallel else errors.by_hand_px
        return np.hypot(relative / _HALF_CONTRAST * _saddle_scatter(radius), beside_px)


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


@final
class GeometryPredictor:
    """Predicts the sigma in px, by axis, of where rays fixed to the panel land."""

    def __init__(self, state: RigState) -> None:
        self._state, self._prior = state, rig_prior(state.rig)
        boards = BoardViews(state)
        self._intrinsics, self._view_of = boards.intrinsics, functools.cache(boards.planned)

    @in_float64
    def sigma(self, captures: Captures, count: float = 1.0) -> float:
        """Root mean square over the sensor and both axes, where each view held by hand counts ``count`` times."""
        steps = self._state.with_captures(captures).steps("geometry")
        planned = (self._view_of(step, step.arrangement) for step in steps if isinstance(step.arrangement, Board))
        shown = [view for view in planned if view is not None]
        points = gather([v.board for v in shown], [v.image for v in shown], [v.sigma for v in shown]).points
        views = [shown[k] for k in points.names]
        parallel = [k for k, view in enumerate(views) if view.parallel]
        if not parallel:
            return math.inf
        points = points.scaled(np.array([1.0 if view.parallel else count**-0.5 for view in views]))
        bundle = Bundle(self._intrinsics, np.array([view.pose for view in views]))
        problem = BundleProblem(points, self._order(points, bundle), self._prior)
        x, cov = with_angles(bundle.intrinsics, bundle.poses, problem.equations_at(bundle).joint_cov(), parallel)
        posterior = Posterior.from_cov(x, cov, functools.partial(term_at, pupil=self._state.geometry.pupil_mm))
        sigma = projection_sigma_px(posterior, sensor_samples(self._state.rig, _ACROSS))
        return float(np.sqrt((sigma**2).mean()))

    def limits(self, captures: Captures) -> Limits:
        """The floor is that when endless views held by hand have determined the lens; see ``Predictor``."""
        return Limits(
            self.sigma(captures, _MANY),
            "The panel's rotation rests on the one view of the board on the jig: a larger or nearer board there, or "
            "corners that scatter less, would lower that.",
        )

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


@final
class NextView:
    """Chooses poses one at a time: where a view lowers most the intrinsic's sigma that is worst.

    Sigmas count in units of those that the procedure's own poses would give, held exactly. Views still to come count
    as those poses do on average. No pose is chosen twice before all others.
    """

    def __init__(self, rig: RigDescription, poses: Sequence[Board]) -> None:
        """Args:
        rig: with the procedure's captures; its nominal values are used.
        poses: to choose from, all of one board.
        """
        state = nominal_state(rig)
        self._views, self._poses, self._open = BoardViews(state), poses, list(range(len(poses)))
        self._known, by_hand = rig_prior(rig).precision, []
        for step in state.steps("geometry"):
            if isinstance(board := step.arrangement, Board):
                information, self._step = self._views.information(self._views.planned(step, board)), step
                if board.parallel_to_panel:
                    self._known = self._known + information
                else:
                    by_hand.append(information)
        self._to_come, self._average = len(by_hand), np.mean(by_hand, axis=0)
        self._usual = _sigma(self._known + np.sum(by_hand, axis=0))
        self._of_poses = np.array([self._views.information(self._views.planned(self._step, pose)) for pose in poses])

    def taken(self, numbers: Int[np.ndarray, " n"], points_px: Float[np.ndarray, "n 2"]) -> None:
        """Count a view that was captured, by the corners seen; see ``BoardViews.seen``."""
        view = self._views.seen(self._step, self._poses[0].spec, numbers, points_px)
        self._known = self._known + self._views.information(view)
        self._to_come -= 1

    def pose(self) -> Board:
        """Return the pose to ask for now; another one each time."""
        self._open = self._open or list(range(len(self._poses)))
        later = max(self._to_come - 1, 0) * self._average
        worst = (_sigma(self._known + later + self._of_poses[self._open]) / self._usual).max(axis=-1)
        return self._poses[self._open.pop(int(worst.argmin()))]


def _sigma(information: Float[np.ndarray, "*k n n"]) -> Float[np.ndarray, "*k n"]:
    return np.asarray(np.sqrt(np.diagonal(scaled_inverse(information, 1e-15), axis1=-2, axis2=-1)))
