"""Geometry: views of a ChArUco board in varied poses, and one on a jig parallel to the panel for the tilt."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from typing import ClassVar, final

import numpy as np

from procedures.aiming import board_facing, board_parallel, low_discrepancy
from procedures.base import Procedure
from procedures.board_walk import BoardVisit
from procedures.checks import shows_board
from procedures.plans import Metered, Stack
from procedures.set_up import set_ups
from procedures.step import Bench, Step, whole_sensor
from udccal.arrangements import Board, BoardSpec, Stage
from udccal.cameras.protocol import Camera
from udccal.displays.protocol import Display
from udccal.guide.drawing import side_view
from udccal.guide.steps import GuidedStep
from udccal.rig import RigDescription
from udccal.sessions.schema import TermName
from udccal.sessions.writer import SessionWriter

_MOST_SQUARES, _FEWEST_SQUARES, _SQUARE_PX = 12, 5, 40.0
_MARKER = 0.75  # marker side over square side
_SPAN_AT_MM, _SPAN = 850.0, 0.6  # at this distance the board spans this part of the view's width
_NEAREST_MM, _FARTHEST_MM = 570.0, 1250.0
_JIG_MM = 700.0
_LEVEL = 0.75
_WHY = "The corners of a board of known size give the lens and the pose of the camera."
_FRAMES = 8
_CHOICE = 3  # poses that a guided view is chosen from, for each view
_MOST_LEAN_RAD, _MOST_TURN_RAD = np.deg2rad(40.0), np.deg2rad(20.0)
# Middle of the board as a fraction of the sensor: centre, corners, edges, repeatedly.
_SPOTS = ((0.5, 0.5), (0.2, 0.2), (0.8, 0.8), (0.8, 0.2), (0.2, 0.8), (0.5, 0.2), (0.5, 0.8), (0.2, 0.5), (0.8, 0.5))


@final
class GeometryProcedure(Procedure):
    """Poses are spread so that corners reach the edges of the field and the board leans in every direction."""

    term: ClassVar[TermName] = "geometry"

    def steps(self, rig: RigDescription) -> Iterator[Step]:
        """Yield the view on the jig, then the views held by hand."""
        spec = board_spec(rig)
        jig = board_parallel(rig, spec, _JIG_MM)
        on_jig = f"Put the board ({_named(spec)}) on the jig that holds it parallel to the display."
        yield _view(rig, "geometry/panel", jig, on_jig)
        for index, board in enumerate(board_poses(rig, spec, rig.captures.board_views)):
            yield _view(rig, f"geometry/view_{index}", board, _describe(rig, board))

    def guided(self, rig: RigDescription) -> Iterator[GuidedStep]:
        """Yield the view on the jig, then all views held by hand as one."""
        yield from set_ups(rig, lambda rig: islice(self.steps(rig), 1))
        yield _by_hand(rig)


def _by_hand(rig: RigDescription) -> GuidedStep:
    spec = board_spec(rig)
    count = rig.captures.board_views
    poses = tuple(board_poses(rig, spec, _CHOICE * count))
    step_ids = tuple(f"geometry/view_{index}" for index in range(count))

    def begin(camera: Camera, display: Display, stage: Stage, writer: SessionWriter) -> BoardVisit:
        bench = Bench(camera, display, stage)
        return BoardVisit(step_ids, poses, lambda step_id, board: _view(rig, step_id, board, ""), bench, writer)

    return GuidedStep(
        id="geometry/views",
        term="geometry",
        title="Board held by hand",
        why=_WHY,
        instruction=f"Hold the board ({_named(spec)}) so that it roughly fills the outline, leaning as the outline "
        f"does, and keep still until the view is taken. Then the next outline is shown, {count} in all.",
        drawing=side_view(rig, poses[0]),
        step_ids=step_ids,
        needs=(),
        frames=_FRAMES * count,
        by_itself=True,
        begin=begin,
    )


def _named(spec: BoardSpec) -> str:
    return f"ChArUco, {spec.columns} x {spec.rows} squares of {spec.square_mm:g} mm, {spec.dictionary}"


def board_spec(rig: RigDescription) -> BoardSpec:
    """Return a board of 12 x 9 squares (fewer for a camera with few pixels), sized in mm for the field of view."""
    columns = int(np.clip(_SPAN * rig.camera.columns / _SQUARE_PX, _FEWEST_SQUARES, _MOST_SQUARES))
    view_mm = _SPAN_AT_MM * rig.camera.columns / rig.focal_px
    square = float(round(_SPAN * view_mm / columns))
    return BoardSpec(columns, round(0.75 * columns), square, _MARKER * square)


def board_poses(rig: RigDescription, spec: BoardSpec, count: int) -> Iterator[Board]:
    """Yield poses that cover the field and lean every way; the first are the same at any ``count``."""
    camera = rig.camera
    for index, (near, lean_x, lean_y, turn) in enumerate(low_discrepancy(count, 4)):
        across, down = _SPOTS[index % len(_SPOTS)]
        reach = 1.0 - abs(across - 0.5) - abs(down - 0.5)  # boards at the corners are held nearer
        distance = _NEAREST_MM + (_FARTHEST_MM - _NEAREST_MM) * float(near) * reach
        lean = (
            float((2 * lean_x - 1) * _MOST_LEAN_RAD),
            float((2 * lean_y - 1) * _MOST_LEAN_RAD),
            float((2 * turn - 1) * _MOST_TURN_RAD),
        )
        yield board_facing(rig, spec, (across * camera.columns, down * camera.rows), distance, lean)


def _view(rig: RigDescription, step_id: str, board: Board, instruction: str) -> Step:
    return Step(
        id=step_id,
        term="geometry",
        arrangement=board,
        instruction=instruction,
        check=shows_board(board.spec),
        region=whole_sensor(rig),
        exposure=Metered(_LEVEL),
        plan=Stack(_FRAMES),
        title="Board on the jig",
        why=_WHY,
    )


def _describe(rig: RigDescription, board: Board) -> str:
    x, y, z = board.translation_mm
    angles = ", ".join(f"{np.rad2deg(angle):.0f}" for angle in board.rotation_vector)
    return (
        f"Hold the board still, its top left corner {x:.0f} mm right of, {y:.0f} mm below and {z:.0f} mm in front of "
        f"the display's top left corner, turned about ({angles}) degrees."
    )
