"""Prediction for geometry: the bundle of the boards that the procedure asks for, and the sigma of rays to the panel.

A planned view holds the corners that it would show, with their scatter. The fit's own equations give the covariance of
intrinsics and poses. The pose of the board on the jig gives the panel's rotation.
"""

from __future__ import annotations

import functools
import math
from typing import final

import jax
import numpy as np
from jaxtyping import Bool

from udccal.arrangements import Board
from udccal.fitting.engine.gaussian import Posterior, scaled_inverse
from udccal.fitting.engine.orders import bic
from udccal.fitting.geometry.bundle import EVERY, ORDERS, Bundle, BundleProblem, Points
from udccal.fitting.geometry.data import rig_prior
from udccal.fitting.geometry.fit import term_at, with_angles
from udccal.models.geometry import panel_directions, project_directions
from udccal.numerics import in_float64
from udccal.planning.board_views import BoardViews, points_of
from udccal.planning.design import Floor
from udccal.planning.state import RigState, sensor_samples
from udccal.rig import Captures

_ACROSS = 17
# Stands for endless views.
_MANY = 1e6
_places, _directions = jax.jit(project_directions), jax.jit(panel_directions)


@final
class GeometryPredictor:
    """Predicts the sigma in px, by axis, of where rays fixed to the panel land."""

    def __init__(self, state: RigState) -> None:
        self._state, self._prior = state, rig_prior(state.rig)
        boards = BoardViews(state)
        self._intrinsics, self._view_of = boards.intrinsics, functools.cache(boards.planned)

    def sigma(self, captures: Captures) -> float:
        """Root mean square over the sensor and both axes; see ``Predictor``."""
        return self._ray_sigma(captures, 1.0)

    def floor(self) -> Floor:
        """The sigma when endless views held by hand have determined the lens."""
        return Floor(
            self._ray_sigma(self._state.rig.captures, _MANY),
            "The panel's rotation rests on the one view of the board on the jig: a larger or nearer board there, or "
            "corners that scatter less, would lower that.",
        )

    def used(self, captures: Captures) -> float:
        """1, since the fit uses all corners; see ``Predictor``."""
        return 1.0

    @in_float64
    def _ray_sigma(self, captures: Captures, count: float) -> float:
        """Sigma in px of rays, by axis, where each view held by hand counts ``count`` times."""
        steps = self._state.with_captures(captures).steps("geometry")
        planned = [self._view_of(step, step.arrangement) for step in steps if isinstance(step.arrangement, Board)]
        views = [view for view in planned if view is not None]
        parallel = [k for k, view in enumerate(views) if view.parallel]
        if not parallel:
            return math.inf
        points = points_of(views).scaled(np.array([1.0 if view.parallel else count**-0.5 for view in views]))
        bundle = Bundle(self._intrinsics, np.array([view.pose for view in views]))
        problem = BundleProblem(points, self._order(points, bundle), self._prior)
        x, cov = with_angles(bundle.intrinsics, bundle.poses, problem.equations_at(bundle).joint_cov(), parallel)
        pupil = np.asarray(self._state.geometry.pupil_mm)
        posterior = Posterior.from_cov(x, cov, functools.partial(term_at, pupil=pupil))
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
