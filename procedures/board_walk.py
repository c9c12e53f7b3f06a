"""A board held in one pose after the other: a view is taken when the board is still and unlike the views before."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from typing import Final, final

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from procedures.aiming import nominal_pixels
from procedures.live import LiveFrames
from procedures.plans import Metered
from procedures.readings import (
    STILL_LOOKS,
    CornersSeen,
    corners_in,
    find_corners,
    head_room,
    moved_px,
    movement,
    sharpness,
    why_not,
)
from procedures.step import Bench, Step, run_step, set_up
from udccal.arrangements import Board, BoardSpec
from udccal.guide.events import Outline, Reading
from udccal.guide.steps import Look
from udccal.planning.geometry import NextView
from udccal.rig import RigDescription
from udccal.sessions.store import Session
from udccal.sessions.writer import SessionWriter

_IN_VAIN_LOOKS: Final = 15  # with too few corners, after which another pose is suggested
_UNLIKE: Final = 0.02  # of the sensor's width, by which the corners of two views differ at least


@final
class BoardVisit:
    """Implements ``udccal.guide.steps.Visit`` for all views held by hand: a capture is one view.

    For each view the pose that would tell most about the lens is suggested as an outline. Any other is taken too whose
    corners lie elsewhere than those of the views before: the board was moved, or it leans in another way.
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
        poses: to choose suggestions from, at least one for each view.
        view: makes the step of a view.
        bench, writer: as for a step.
        """
        self._rig, self._step_ids, self._view = writer.manifest.rig, step_ids, view
        self._bench, self._writer = bench, writer
        self._next = NextView(self._rig, poses)
        self._views: list[CornersSeen] = []
        for seen in _captured(step_ids, writer, poses[0].spec):
            self._count(seen)
        self._seen: deque[CornersSeen] = deque(maxlen=STILL_LOOKS)
        self._in_vain = 0
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
        readings = (room, corners, sharpness(frame), movement(self._seen), self._unlike(seen))
        wanted = Outline(_polygon(_edge(self._rig, self._board)), "wanted")
        return Look(frame, readings, self._why_not(readings), (wanted, *seen.outlines))

    def capture(self) -> Iterator[int]:
        """Take the view; raises as ``run_step`` does."""
        view = self._seen[-1]
        self._seen.clear()
        run_step(self._asked, self._bench, self._writer, None)
        self._count(view)
        if any(step_id not in self._writer.completed_ids for step_id in self._step_ids):
            self._asked = self._ask()
        yield 0

    def _count(self, view: CornersSeen) -> None:
        self._views.append(view)
        self._next.taken(view.numbers, view.points_px)

    def _ask(self) -> Step:
        """Suggest the pose of the next view, or another one where that had nothing new to show."""
        done = self._writer.completed_ids
        step = self._view(next(step_id for step_id in self._step_ids if step_id not in done), self._next.pose())
        set_up(step, self._bench, self._writer)
        self._in_vain = 0
        return step

    def _unlike(self, seen: CornersSeen) -> Reading:
        width = float(self._rig.camera.columns)
        nearest = min((moved_px(view, seen) for view in self._views), default=width)
        return Reading("unlike other views", nearest, _UNLIKE * width, None, "px")

    def _why_not(self, readings: tuple[Reading, ...]) -> str:
        room, corners, sharp, moving, unlike = readings
        if not room.ok:
            return why_not(room)
        if not corners.ok:
            self._look_in_vain(corners.value > 0)
            return (
                f"{corners.value:.0f} of the board's corners are seen, at least {corners.low:.0f} are needed. Hold the "
                "board in the outline, evenly lit and flat."
            )
        if not moving.ok:
            return why_not(moving)
        if not sharp.ok:
            return why_not(sharp)
        if not unlike.ok:
            self._asked = self._ask()
            self._seen.clear()
            return "Such a view is there already. Hold the board as the outline shows it."
        return ""

    def _look_in_vain(self, board: bool) -> None:
        """Suggest another pose where a board has been seen in part for long: this one may not be seen any better."""
        self._in_vain = self._in_vain + 1 if board else 0
        if self._in_vain >= _IN_VAIN_LOOKS:
            self._asked = self._ask()
            self._seen.clear()


def _edge(rig: RigDescription, board: Board) -> Float[np.ndarray, "4 2"]:
    """Return where a nominal camera sees the board's outer corners."""
    right, down = board.spec.columns * board.spec.square_mm, board.spec.rows * board.spec.square_mm
    on_board = np.array([[0, 0, 0], [right, 0, 0], [right, down, 0], [0, down, 0]])
    return nominal_pixels(rig, Rotation.from_rotvec(board.rotation_vector).apply(on_board) + board.translation_mm)


def _captured(step_ids: tuple[str, ...], writer: SessionWriter, spec: BoardSpec) -> Iterator[CornersSeen]:
    """Yield the views that the session holds; how the board was held is read from their pictures."""
    session = Session(writer.path, writer.manifest)
    for step_id in step_ids:
        if step_id in writer.completed_ids:
            yield corners_in(session.average(session.step(step_id).captures[0]).mean, spec)


def _polygon(points: Float[np.ndarray, "n 2"]) -> tuple[tuple[float, float], ...]:
    return tuple((float(x), float(y)) for x, y in points)
