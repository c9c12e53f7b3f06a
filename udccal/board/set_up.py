"""What a person needs in front of the rig: the board that the geometry's procedure asks for, its jig, and the LED."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import cv2
import numpy as np

from udccal.arrangements import Board, BoardSpec, Led
from udccal.errors import RigError
from udccal.plugins import find_procedure
from udccal.rig import RigDescription
from udccal.sessions.schema import TermName

# Smaller squares have marker bits that no camera of these rigs resolves.
_SMALLEST_SQUARE_MM = 1.0


@final
@dataclass(frozen=True)
class SetUp:
    """Measures of the board, its poses and the LED, all in mm.

    Attributes:
        board: as it must be printed.
        jig_mm: the board's outer top left corner on the jig, in the panel's frame (x right, y down, z to the viewer).
        views: how many poses are held by hand.
        views_mm: least and greatest distance of the board's middle from the panel in these poses.
        led_mm: diameter of the LED; None where the rig's psf is not captured.
        led_distance_mm: distance of the LED from the panel; None likewise.
    """

    board: BoardSpec
    jig_mm: tuple[float, float, float]
    views: int
    views_mm: tuple[float, float]
    led_mm: float | None
    led_distance_mm: float | None

    @property
    def width_mm(self) -> float:
        """Width of the board."""
        return self.board.columns * self.board.square_mm

    @property
    def height_mm(self) -> float:
        """Height of the board."""
        return self.board.rows * self.board.square_mm


def set_up_of(rig: RigDescription) -> SetUp:
    """Read the installed procedures' steps.

    Raises:
        UdccalError: when a procedure is not installed.
        RigError: when the geometry has no board on a jig, or one with squares too small to print.
    """
    boards = [one for one in _arrangements("geometry", rig) if isinstance(one, Board)]
    jig = next((board for board in boards if board.parallel_to_panel), None)
    if jig is None:
        raise RigError(
            f"Expected the geometry's procedure to have a step with a board on a jig, found none for {rig.name}. "
            "Use the procedure that udccal installs, or print the board of your own."
        )
    if jig.spec.square_mm < _SMALLEST_SQUARE_MM:
        raise RigError(
            f"Expected a board whose squares are at least {_SMALLEST_SQUARE_MM:g} mm, found {jig.spec.square_mm:g} mm: "
            f"the view of {rig.name} is too narrow. Check focal_mm and pitch_um: udccal rig check {rig.name}"
        )
    depths = [_middle_depth_mm(board) for board in boards if board is not jig] or [_middle_depth_mm(jig)]
    led = next((one for one in _arrangements("psf", rig) if isinstance(one, Led)), None)
    return SetUp(
        board=jig.spec,
        jig_mm=jig.translation_mm,
        views=len(boards) - 1,
        views_mm=(min(depths), max(depths)),
        led_mm=None if led is None else led.diameter_mm,
        led_distance_mm=None if led is None else led.distance_mm,
    )


def _arrangements(term: TermName, rig: RigDescription) -> list[Any]:
    steps: Any = find_procedure(term)().steps(rig)
    return [step.arrangement for step in steps]


def _middle_depth_mm(board: Board) -> float:
    rotation, _ = cv2.Rodrigues(np.asarray(board.rotation_vector))
    middle = np.array([board.spec.columns, board.spec.rows, 0.0]) * board.spec.square_mm / 2
    return float(rotation[2] @ middle + board.translation_mm[2])
