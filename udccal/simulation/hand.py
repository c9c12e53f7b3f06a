"""A hand at a simulated rig: it sets up what it is told to, as inexactly as people do, and wrongly when told to."""

from __future__ import annotations

from dataclasses import replace
from typing import final
from zlib import crc32

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from udccal.arrangements import Arrangement, Board, Dark, FlatLight, Led, Occasion
from udccal.simulation.world import SimulatedWorld

# Errors of places, in px and as a part of the sensor's width.
_AIM_PX, _AIM = 20.0, 0.02


@final
class Hand:
    """Implements ``udccal.arrangements.Stage`` on a simulated world.

    The same steps of the same world, begun anew, have the same errors. An LED or board that is asked for at one place
    again stays where it is. A short way is gone more exactly than a long one: an error is at most half the way.
    """

    def __init__(self, world: SimulatedWorld, lean_deg: float = 3.0) -> None:
        """Args:
        world: what is arranged. Places are up to 20 px off in x and in y, less on a sensor of few pixels.
        lean_deg: largest error of a board's lean about each axis.
        """
        self._world, self._lean_deg = world, lean_deg
        self._aim_px = min(_AIM_PX, _AIM * world.truth.description.camera.columns)
        self._told: tuple[Arrangement, Occasion] | None = None
        self._placed: Arrangement = Dark()
        self._moves = 0
        self._mistakes = 0
        self._wrong: Arrangement | None = None

    def arrange(self, arrangement: Arrangement, occasion: Occasion) -> None:
        """Set up what is asked for; while a mistake stands, go on with the mistake."""
        before = self._told
        self._told = (arrangement, occasion)
        if before is None or before[1].step_id != occasion.step_id:
            self._moves = 0
            self._placed = self._inexact(arrangement, occasion)
        elif not _same(before[0], arrangement):
            self._moves += 1
            self._placed = self._inexact(arrangement, occasion)
        self._world.arrange(self._wrong or self._placed, occasion)

    def mistake(self) -> None:
        """Set up something wrong instead of what was asked for last: another mistake each time."""
        if self._told is None:
            return
        wrong = _mistakes(self._placed, self._world)
        self._wrong = wrong[self._mistakes % len(wrong)]
        self._mistakes += 1
        self._world.arrange(self._wrong, self._told[1])

    def correct(self) -> None:
        """Begin anew: set up as asked what is asked for next."""
        self._wrong, self._told, self._placed = None, None, Dark()

    def _inexact(self, arrangement: Arrangement, occasion: Occasion) -> Arrangement:
        seed = [self._world.seed, 0x4A4D, crc32(occasion.step_id.encode()), self._moves]
        rng = np.random.default_rng(seed)
        match arrangement:
            case Led(x_px, y_px):
                right, down = self._aim(arrangement) * rng.uniform(-1, 1, 2)
                return replace(arrangement, x_px=x_px + float(right), y_px=y_px + float(down))
            case Board(parallel_to_panel=False):
                return self._held(arrangement, rng)
            case _:
                return arrangement  # nothing is aimed; a jig holds its board exactly

    def _aim(self, led: Led) -> float:
        """Return the largest error of the LED's place, in px."""
        if not isinstance(self._placed, Led):
            return self._aim_px
        way = max(abs(led.x_px - self._placed.x_px), abs(led.y_px - self._placed.y_px))
        return min(self._aim_px, way / 2)

    def _held(self, board: Board, rng: np.random.Generator) -> Board:
        """Return the board turned about its middle, and moved aside."""
        lean = Rotation.from_euler("xyz", self._lean_deg * rng.uniform(-1, 1, 3), degrees=True)
        turned = Rotation.from_rotvec(board.rotation_vector)
        half = np.array([board.spec.columns, board.spec.rows, 0.0]) * board.spec.square_mm / 2
        middle = turned.apply(half) + board.translation_mm
        aside_mm = self._aim_px * middle[2] / self._world.truth.description.focal_px
        middle = middle + np.append(aside_mm * rng.uniform(-1, 1, 2), 0.0)
        rotation = turned * lean
        return replace(
            board, rotation_vector=_three(rotation.as_rotvec()), translation_mm=_three(middle - rotation.apply(half))
        )


def _mistakes(arrangement: Arrangement, world: SimulatedWorld) -> tuple[Arrangement, ...]:
    """Return wrong arrangements: an LED elsewhere or in a lit room, no board, no light, light where there is none."""
    camera = world.truth.description.camera
    match arrangement:
        case Led(x_px, y_px):
            return replace(arrangement, x_px=camera.columns - 1 - x_px, y_px=camera.rows / 3 + y_px / 4), FlatLight()
        case FlatLight():
            return (Dark(),)
        case _:
            return (FlatLight(),)


def _same(one: Arrangement, other: Arrangement) -> bool:
    """Whether nothing has to be moved; a picture of the panel is never moved."""
    return type(one) is type(other) and (not isinstance(one, Led | Board) or one == other)


def _three(values: Float[np.ndarray, "3"]) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return (x, y, z)
