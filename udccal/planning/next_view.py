"""How a board should be held next: hands miss the poses of a procedure, and later views make up for what is missing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import final

import numpy as np
from jaxtyping import Float, Int

from udccal.arrangements import Board
from udccal.fitting.engine.gaussian import scaled_inverse
from udccal.fitting.geometry.data import rig_prior
from udccal.planning.board_views import BoardViews, lens_information
from udccal.planning.state import nominal_state
from udccal.planning.steps import planned_steps
from udccal.rig import RigDescription


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
        self._views = BoardViews(state)
        self._spec = poses[0].spec
        prior, by_hand = rig_prior(rig).precision, []
        for step in planned_steps("geometry", state):
            if isinstance(board := step.arrangement, Board):
                told = lens_information(self._views.planned(step, board), self._views.intrinsics)
                if board.parallel_to_panel:
                    prior = prior + told
                else:
                    self._step = step
                    by_hand.append(told)
        self._known, self._to_come, self._average = prior, len(by_hand), np.mean(by_hand, axis=0)
        self._usual = _sigma(prior + np.sum(by_hand, axis=0))
        self._poses = poses
        self._tell = np.array(
            [lens_information(self._views.planned(self._step, pose), self._views.intrinsics) for pose in poses]
        )
        self._open = list(range(len(poses)))

    def taken(self, numbers: Int[np.ndarray, " n"], points_px: Float[np.ndarray, "n 2"]) -> None:
        """Count a view that was captured.

        Args:
            numbers: of the corners seen, as OpenCV counts them.
            points_px: where they are on the sensor.
        """
        view = self._views.seen(self._step, self._spec, numbers, points_px)
        self._known = self._known + lens_information(view, self._views.intrinsics)
        self._to_come -= 1

    def pose(self) -> Board:
        """Return the pose to ask for now; another one each time."""
        self._open = self._open or list(range(len(self._poses)))
        later = max(self._to_come - 1, 0) * self._average
        worst = (_sigma(self._known + later + self._tell[self._open]) / self._usual).max(axis=-1)
        return self._poses[self._open.pop(int(worst.argmin()))]


def _sigma(information: Float[np.ndarray, "*k n n"]) -> Float[np.ndarray, "*k n"]:
    return np.asarray(np.sqrt(np.diagonal(scaled_inverse(information, 1e-15), axis1=-2, axis2=-1)))
