"""Prediction for geometry: a bundle of boards where the procedure asks for them, and how sure rays are for the panel.

Lens and one pose per view are estimated together; the board on the jig has the panel's rotation.
"""

from __future__ import annotations

from typing import final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from udccal.arrangements import Board
from udccal.fitting.engine.gaussian import scaled_inverse
from udccal.fitting.geometry.bundle_orders import ORDERS
from udccal.fitting.geometry.fit import rig_prior
from udccal.models.geometry import Geometry, project, rotation_matrix, unproject
from udccal.numerics import in_float64
from udccal.planning.board_views import LENS, PlannedView, lens_vector, planned_view
from udccal.planning.forecast import Floor
from udccal.planning.state import EvenField, RigState, sensor_samples
from udccal.planning.steps import planned_steps
from udccal.rig import Captures

_GRID = 17
# Stands for endless views.
_MANY = 1e6


@final
class GeometryPredictor:
    """Predicts the sigma in px, by axis, of where rays fixed to the panel land."""

    def __init__(self, state: RigState) -> None:
        self._state = state
        self._field = EvenField(state)
        self._lens = lens_vector(state.geometry)
        self._rays = _ray_slopes(self._lens, sensor_samples(state.rig, _GRID))
        self._known: dict[Board, PlannedView | None] = {}

    def sigma(self, captures: Captures) -> float:
        """Root mean square over the sensor and both axes; see ``prediction.Predictor``."""
        return self._projection(self._views(captures), 1.0)

    def floor(self) -> Floor:
        """Where endless views have told all of the lens."""
        return Floor(
            self._projection(self._views(self._state.rig.captures), _MANY),
            "The panel's rotation rests on the one view of the board on the jig: a larger or nearer board there, or "
            "corners that scatter less, would lower that.",
        )

    def used(self, captures: Captures) -> float:
        """All corners; see ``prediction.Predictor``."""
        return 1.0

    @in_float64
    def _views(self, captures: Captures) -> list[PlannedView]:
        views = []
        for step in planned_steps("geometry", self._state.with_captures(captures)):
            board = step.arrangement
            if not isinstance(board, Board):
                continue
            if board not in self._known:
                self._known[board] = planned_view(self._state, self._field, step, board)
            if (view := self._known[board]) is not None:
                views.append(view)
        return views

    def _projection(self, views: list[PlannedView], weight: float) -> float:
        """Views held by hand count ``weight`` times."""
        if not any(view.parallel for view in views):
            return float("inf")
        information = sum(
            (view.information * (1.0 if view.parallel else weight) for view in views), start=np.zeros((12, 12))
        )
        information[:LENS, :LENS] += np.diag(rig_prior(self._state.rig).precision)
        samples = 2 * sum(view.corners for view in views)
        free = self._order(information, 12 + 6 * len(views) - 9, samples)
        cov, slopes = scaled_inverse(information[np.ix_(free, free)]), self._rays[:, :, free]
        return float(np.sqrt(np.einsum("nai,ij,naj->na", slopes, cov, slopes).mean()))

    def _order(self, information: Float[np.ndarray, "12 12"], others: int, samples: int) -> Bool[np.ndarray, "12"]:
        """The distortions that the data are expected to ask for, by the fit's own criterion, n ln(chi2) + k ln(n)."""
        cov = scaled_inverse(information)
        freedom = max(samples - others, 1)
        scores = []
        for _, order in ORDERS:
            held = 4 + np.flatnonzero(1 - np.array(order))
            rise = float(self._lens[held] @ scaled_inverse(cov[np.ix_(held, held)]) @ self._lens[held])
            scores.append(samples * np.log1p(rise / freedom) + sum(order) * np.log(samples))
        chosen = ORDERS[int(np.argmin(scores))][1]
        return np.array((1, 1, 1, 1, *chosen, 1, 1, 1), dtype=bool)


@in_float64
def _ray_slopes(lens: Float[np.ndarray, "9"], pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2 12"]:
    return np.asarray(_slopes(lens, pixels), dtype=np.float64)


@jax.jit
def _slopes(lens: Float[Array, "9"], pixels: Float[Array, "n 2"]) -> Float[Array, "n 2 12"]:
    """Of where the rays of these pixels land, by the lens and by a turn of the panel in camera coordinates."""

    def camera(x: Float[Array, "9"]) -> Geometry:
        return Geometry(x[:2], x[2:4], x[4:9], jnp.zeros(3), jnp.zeros(3))

    ideal = unproject(camera(lens), pixels)
    rays = jnp.concatenate([ideal, jnp.ones_like(ideal[:, :1])], axis=1)

    def seen(x: Float[Array, "12"]) -> Float[Array, "n 2"]:
        return project(camera(x[:LENS]), rays @ rotation_matrix(x[LENS:]).T)

    return jax.jacfwd(seen)(jnp.concatenate([lens, jnp.zeros(3)]))
