"""How a board should be held next: hands miss the poses of a procedure, and later views make up for what is missing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import final

import numpy as np
from jaxtyping import Float, Int

from udccal.arrangements import Board
from udccal.fitting.engine.gaussian import scaled_inverse
from udccal.fitting.geometry.data import rig_prior
from udccal.planning.board_views import BoardView, BoardViews, lens_information
from udccal.planning.state import nominal_state
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
        self._views, self._poses, self._open = BoardViews(state), poses, list(range(len(poses)))
        self._known, by_hand = rig_prior(rig).precision, []
        for step in state.steps("geometry"):
            if isinstance(board := step.arrangement, Board):
                told, self._step = self._told(self._views.planned(step, board)), step
                if board.parallel_to_panel:
                    self._known = self._known + told
                else:
                    by_hand.append(told)
        self._to_come, self._average = len(by_hand), np.mean(by_hand, axis=0)
        self._usual = _sigma(self._known + np.sum(by_hand, axis=0))
        self._tell = np.array([self._told(self._views.planned(self._step, pose)) for pose in poses])

    def taken(self, numbers: Int[np.ndarray, " n"], points_px: Float[np.ndarray, "n 2"]) -> None:
        """Count a view that was captured.

        Args:
            numbers: of the corners seen, as OpenCV counts them.
            points_px: where they are on the sensor.
        """
        self._known = self._known + self._told(self._views.seen(self._step, self._poses[0].spec, numbers, points_px))
        self._to_come -= 1

    def pose(self) -> Board:
        """Return the pose to ask for now; another one each time."""
        self._open = self._open or list(range(len(self._poses)))
        later = max(self._to_come - 1, 0) * self._average
        worst = (_sigma(self._known + later + self._tell[self._open]) / self._usual).max(axis=-1)
        return self._poses[self._open.pop(int(worst.argmin()))]

    def _told(self, view: BoardView | None) -> Float[np.ndarray, "9 9"]:
        return lens_information(view, self._views.intrinsics)


def _sigma(information: Float[np.ndarray, "*k n n"]) -> Float[np.ndarray, "*k n"]:
    return np.asarray(np.sqrt(np.diagonal(scaled_inverse(information, 1e-15), axis1=-2, axis2=-1)))
