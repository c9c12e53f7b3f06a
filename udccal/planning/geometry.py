"""Prediction for geometry: the bundle of the boards that the procedure asks for, and the sigma of rays to the panel.

A planned view holds the corners that it would show, with their scatter. The fit's own equations give the covariance of
intrinsics and poses. The pose of the board on the jig gives the panel's rotation.
"""

from __future__ import annotations

from functools import partial
from typing import final

import jax
import numpy as np
from jaxtyping import Bool

from udccal.arrangements import Board
from udccal.fitting.engine.gaussian import Posterior, scaled_inverse
from udccal.fitting.engine.orders import bic
from udccal.fitting.geometry.bundle import (
    EVERY,
    ORDERS,
    Bundle,
    BundleProblem,
    Points,
)
from udccal.fitting.geometry.data import rig_prior
from udccal.fitting.geometry.fit import term_at, with_angles
from udccal.models.geometry import panel_directions, project_directions
from udccal.numerics import in_float64
from udccal.planning.board_views import BoardView, BoardViews, points_of
from udccal.planning.design import Floor
from udccal.planning.state import RigState, sensor_samples
from udccal.planning.steps import planned_steps
from udccal.rig import Captures

_ACROSS = 17
# Stands for endless views.
_MANY = 1e6
_places, _directions = jax.jit(project_directions), jax.jit(panel_directions)


@final
class GeometryPredictor:
    """Predicts the sigma in px, by axis, of where rays fixed to the panel land."""

    def __init__(self, state: RigState) -> None:
        self._state = state
        self._boards = BoardViews(state)
        self._prior = rig_prior(state.rig)
        self._known: dict[Board, BoardView | None] = {}

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

    def _views(self, captures: Captures) -> list[BoardView]:
        views = []
        for step in planned_steps("geometry", self._state.with_captures(captures)):
            if isinstance(board := step.arrangement, Board):
                if board not in self._known:
                    self._known[board] = self._boards.planned(step, board)
                views.append(self._known[board])
        return [view for view in views if view is not None]

    @in_float64
    def _ray_sigma(self, views: list[BoardView], count: float) -> float:
        """Sigma in px of rays, by axis, where each view held by hand counts ``count`` times."""
        parallel = [k for k, view in enumerate(views) if view.parallel]
        if not parallel:
            return float("inf")
        by_hand = [1.0 if view.parallel else count**-0.5 for view in views]
        points = points_of(views).scaled(np.array(by_hand))
        bundle = Bundle(self._boards.intrinsics, np.array([view.pose for view in views]))
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
            held = self._boards.intrinsics * ~free
            rise = float(held @ scaled_inverse(cov * np.outer(~free, ~free)) @ held)
            return bic(samples * float(np.log1p(rise / freedom)), float(free.sum()), samples)

        return min(ORDERS.values(), key=criterion)
