"""A board held in one pose after the other: a view is taken when the board is still and the view adds information."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from typing import Final, final

import cv2
import numpy as np
from jaxtyping import Float

from procedures.aiming import nominal_pixels
from procedures.board_information import LensInformation
from procedures.live import LiveFrames
from procedures.plans import Metered
from procedures.readings import CornersSeen, find_corners, head_room, sharpness, why_not
from procedures.step import Bench, Step, run_step, set_up
from udccal.arrangements import Board, BoardSpec
from udccal.guide.events import Outline, Reading
from udccal.guide.steps import Look
from udccal.rig import RigDescription
from udccal.sessions.writer import SessionWriter

_STILL_PX, _STILL_LOOKS, _UNKNOWN_PX = 1.0, 3, 99.0
_FEWEST_COMMON: Final = 4
_NEWS: Final = 50.0  # % of what the suggested pose would add


@final
class BoardVisit:
    """Implements ``udccal.guide.steps.Visit`` for all views held by hand: a capture is one view.

    For each view a pose is suggested as an outline. Any other is taken too that adds half as much information.
    """

    def __init__(
        self,
        step_ids: tuple[str, ...],
        poses: tuple[Board, ...],
        view: Callable[[str, Board], Step],
        bench: Bench,
        writer: SessionWriter,
    ) -> None:
        """Args:
        step_ids: the views.
        poses: suggestions, at least one for each view.
        view: makes the step of a view.
        bench, writer: as for a step.
        """
        self._rig, self._step_ids, self._poses, self._view = writer.manifest.rig, step_ids, poses, view
        self._bench, self._writer = bench, writer
        self._lens = LensInformation(self._rig)
        for number, step_id in enumerate(step_ids):
            if step_id in writer.completed_ids:  # how it was held is in its picture; it is taken to be as suggested
                self._lens.add(self._lens.of_board(poses[number]))
        self._seen: deque[CornersSeen] = deque(maxlen=_STILL_LOOKS)
        self._tries = 0
        self._asked = self._ask()
        step = self._asked
        assert isinstance(step.exposure, Metered)
        self._target = step.exposure.target
        self._live = LiveFrames(bench.camera, step.region, step.exposure, self._rig)

    @property
    def _board(self) -> Board:
        assert isinstance(self._asked.arrangement, Board)
        return self._asked.arrangement

    def look(self) -> Look:
        """Take a frame, find the board, and say how it should be held."""
        frame, level = self._live.next()
        room, seen = head_room(level, self._target), find_corners(frame, self._board.spec)
        corners = seen.reading(self._board.spec)
        self._seen.append(seen)
        readings = (room, corners, sharpness(frame), _movement(self._seen), self._news(seen))
        wanted = Outline(_polygon(_edge(self._rig, self._board)), "wanted")
        if not len(seen.numbers):
            return Look(frame, readings, self._why_not(readings), (wanted,))
        hull = cv2.convexHull(seen.points_px.astype(np.float32)).reshape(-1, 2)
        return Look(frame, readings, self._why_not(readings), (wanted, Outline(_polygon(hull), "seen")))

    def capture(self) -> Iterator[None]:
        """Take the view; raises as ``run_step`` does."""
        information = self._lens.of_corners(self._seen[-1], self._board.spec)
        self._seen.clear()
        run_step(self._asked, self._bench, self._writer, None)
        self._lens.add(information)
        self._tries = 0
        if any(step_id not in self._writer.completed_ids for step_id in self._step_ids):
            self._asked = self._ask()
        yield

    def _ask(self) -> Step:
        """Suggest the pose of the next view, or another one where that had nothing new to show."""
        done = self._writer.completed_ids
        number = next(number for number, step_id in enumerate(self._step_ids) if step_id not in done)
        step = self._view(self._step_ids[number], self._poses[(number + self._tries) % len(self._poses)])
        set_up(step, self._bench, self._writer)
        return step

    def _news(self, seen: CornersSeen) -> Reading:
        gain, suggested = (
            self._lens.gain(information)
            for information in (self._lens.of_corners(seen, self._board.spec), self._lens.of_board(self._board))
        )
        return Reading("news of the lens", 100 * gain / max(suggested, 1e-6), _NEWS, None, "%")

    def _why_not(self, readings: tuple[Reading, ...]) -> str:
        room, corners, sharp, movement, news = readings
        if not room.ok:
            return why_not(room)
        if not corners.ok:
            return (
                f"{corners.value:.0f} of the board's corners are seen, at least {corners.low:.0f} are needed. Hold the "
                "board in the outline, evenly lit and flat."
            )
        if not movement.ok:
            return "Hold the board still."
        if not sharp.ok:
            return why_not(sharp)
        if not news.ok:
            self._tries += 1
            self._asked = self._ask()
            self._seen.clear()
            return "This view shows little that is new. Hold the board as the outline shows it."
        return ""


def _movement(looks: deque[CornersSeen]) -> Reading:
    """Return the largest movement of a corner over the last looks; unknown, and too large, before there are enough."""
    moved = _UNKNOWN_PX
    if len(looks) == _STILL_LOOKS:
        moved = max(_moved_px(earlier, looks[-1]) for earlier in looks)
    return Reading("movement", moved, None, _STILL_PX, "px")


def _moved_px(one: CornersSeen, other: CornersSeen) -> float:
    common, first, second = np.intersect1d(one.numbers, other.numbers, return_indices=True)
    if len(common) < _FEWEST_COMMON:
        return _UNKNOWN_PX
    return float(np.median(np.linalg.norm(one.points_px[first] - other.points_px[second], axis=1)))


def _edge(rig: RigDescription, board: Board) -> Float[np.ndarray, "4 2"]:
    """Return where a nominal camera sees the board's corners."""
    spec: BoardSpec = board.spec
    width, height = spec.columns * spec.square_mm, spec.rows * spec.square_mm
    corners = np.array([[0, 0, 0], [width, 0, 0], [width, height, 0], [0, height, 0.0]])
    turn = cv2.Rodrigues(np.array(board.rotation_vector))[0]
    return nominal_pixels(rig, corners @ turn.T + np.array(board.translation_mm))


def _polygon(points: Float[np.ndarray, "n 2"]) -> tuple[tuple[float, float], ...]:
    return tuple((float(x), float(y)) for x, y in points)
