"""An LED walked over the field: brackets are taken where it rests in a cell of the field; its place is measured."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final, final

import numpy as np

from procedures.aiming import low_discrepancy
from procedures.checks import move_led, shows_led
from procedures.live import LiveFrames
from procedures.metering import saturation_DN, trial_frame
from procedures.plans import Bracket, Metered
from procedures.readings import LedSeen, find_led, head_room, led_change, why_not
from procedures.step import Bench, Step, exposure_of, take_step, whole_sensor
from udccal.arrangements import Led, Occasion
from udccal.cameras.protocol import Frame, Region
from udccal.errors import CaptureError
from udccal.guide.events import Outline, Reading
from udccal.guide.steps import Look
from udccal.rig import RigDescription
from udccal.sessions.captured import Capture, SingleFrame
from udccal.sessions.schema import LedSubject
from udccal.sessions.writer import SessionWriter

CELL_PX: Final = 2.0  # side of the Bayer pattern's cell: places of the LED count within it
# Brackets of one position lie this close to its first in x and y, less a margin: the fit takes them together then.
_TOGETHER_PX: Final = 3.5
_STILL_LOOKS: Final = 3
# Of the distance of places that are spread as evenly as can be. Chance finds a new one in two or three nudges.
_APART: Final = 0.4
_SEEN: Final = 0.2  # of the range
# (x, y) on the sensor in px.
Place = tuple[float, float]


@final
@dataclass(frozen=True)
class FieldCell:
    """One cell of the field.

    Attributes:
        place_px: (x, y) where the LED's image is wanted.
        half_px: how far off it may be in x and in y.
        step_ids: of the brackets that it gets.
    """

    place_px: Place
    half_px: Place
    step_ids: tuple[str, ...]

    @property
    def outline(self) -> Outline:
        """The cell as a polygon."""
        (x, y), (w, h) = self.place_px, self.half_px
        return Outline(((x - w, y - h), (x + w, y - h), (x + w, y + h), (x - w, y + h)), "wanted")


def phase_distance_px(count: int) -> float:
    """Return how far apart the places of ``count`` brackets lie within the Bayer cell at least."""
    evenly = np.sqrt(2 / np.sqrt(3) * CELL_PX**2 / count)  # of a hexagonal lattice
    return float(_APART * evenly)


def nearest_phase_px(place_px: Place, earlier_px: list[Place]) -> float:
    """Return the distance of a place to the nearest of the earlier ones, all taken within the Bayer cell."""
    if not earlier_px:
        return CELL_PX
    apart = np.abs(np.asarray(earlier_px) - place_px) % CELL_PX
    return float(np.linalg.norm(np.minimum(apart, CELL_PX - apart), axis=1).min())


def region_around(rig: RigDescription, x_px: float, y_px: float) -> Region:
    """Return the region with the LED near its middle; at the sensor's edge it is moved inwards and keeps its size."""
    captures, camera = rig.captures, rig.camera
    columns = min(captures.psf_region_columns, camera.columns) // 2 * 2
    rows = min(captures.psf_region_rows, camera.rows) // 2 * 2
    x = min(max(x_px - columns / 2, 0), camera.columns - columns)
    y = min(max(y_px - rows / 2, 0), camera.rows - rows)
    return Region(int(x) // 2 * 2, int(y) // 2 * 2, columns, rows)


@final
class LedVisit:
    """Implements ``udccal.guide.steps.Visit`` for one cell of the field: a capture is one bracket.

    A cell that was left half done begins anew: nobody brings the LED back to within the few px that its brackets share.
    Where the session holds all of a cell, its brackets are exchanged together: old and new ones do not lie together.
    """

    def __init__(self, cell: FieldCell, exposure: Metered, bench: Bench, writer: SessionWriter) -> None:
        self._rig, self._cell, self._exposure = writer.manifest.rig, cell, exposure
        self._bench, self._writer = bench, writer
        self._exchanged = all(writer.step(step_id) is not None for step_id in cell.step_ids)
        self._waiting: list[tuple[str, LedSubject, tuple[Capture, ...]]] = []
        writer.capture_again([step_id for step_id in cell.step_ids if step_id in writer.completed_ids])
        self._live = LiveFrames(bench.camera, whole_sensor(self._rig), exposure, self._rig)
        self._taken_px: list[Place] = []
        self._near_px = cell.place_px
        self._looks: deque[Frame] = deque(maxlen=_STILL_LOOKS)
        self._nudges = 0
        bench.display.off()
        self._asked = self._ask(cell.place_px)

    def look(self) -> Look:
        """Take a frame of the whole sensor, find the LED, and say where it should go or that it should rest."""
        frame, level = self._live.next()
        led, room = find_led(frame, self._rig), head_room(level, None)
        seen = led.peak_DN > _SEEN * (saturation_DN(self._rig) - self._rig.camera.black_DN.value)
        if not seen or not led.room.ok or not room.ok:
            self._looks.clear()
            if not seen:
                self._ask_inwards()
            return Look(frame, (room, led.room), self._why_unseen(seen, led, room), (self._wanted(),))
        self._near_px = led.place_px
        self._looks.append(frame)
        readings = (room, led.room, self._off(led.place_px), self._movement(), self._new_phase(led.place_px))
        outlines = (self._wanted(), Outline((led.place_px,), "seen"))
        return Look(frame, readings, self._where_next(readings, led.place_px), outlines)

    def capture(self) -> Iterator[int]:
        """Take a bracket of the LED where it rests.

        Raises:
            CaptureError: when the LED moves meanwhile, or as ``take_step`` does.
        """
        near, step_id = self._near_px, self._cell.step_ids[len(self._taken_px)]
        region = region_around(self._rig, *(self._taken_px or [near])[0])
        plan = Bracket(self._rig.captures.psf_exposures)
        step = Step(step_id, "psf", self._asked, "", shows_led(*near), region, self._exposure, plan)
        self._looks.clear()
        start_s = exposure_of(self._cell.step_ids[0], self._writer) if self._taken_px else None
        captures = take_step(step, self._bench, self._writer, start_s)
        place = self._held_place(captures[0], region)
        led = LedSubject(
            x_px=place[0], y_px=place[1], distance_mm=self._asked.distance_mm, diameter_mm=self._asked.diameter_mm
        )
        self._waiting.append((step_id, led, captures))
        self._taken_px.append(place)
        whole = len(self._taken_px) == len(self._cell.step_ids)
        if whole or not self._exchanged:
            self._store()
        if not whole:
            self._ask_from(place, self._next_phase())
        yield sum(len(taken) for _, _, taken in self._waiting)

    def _store(self) -> None:
        """Add the brackets that wait; with a cell's first one, those of an earlier visit leave the session."""
        first, *others = self._cell.step_ids
        for step_id, led, captures in self._waiting:
            self._writer.add_step(step_id, "psf", led, captures, without=others if step_id == first else ())
        self._waiting.clear()

    def _held_place(self, first: Capture, region: Region) -> Place:
        """Return where the LED was in the first frame of a bracket, once it is sure that it still is there."""
        assert isinstance(first, SingleFrame)
        after = trial_frame(self._bench.camera, region, first.frame.settings.exposure_s)
        change = led_change(first.frame, after, self._rig)
        if not change.ok:
            raise CaptureError(
                f"Expected the LED to rest, found that its picture changed by {change.value:.0f}% (at most "
                f"{change.high:.0f}% at rest) while its frames were taken. Put it on something firm."
            )
        return find_led(first.frame, self._rig).place_px

    def _ask(self, place_px: Place) -> Led:
        """Have the LED brought to a place by whoever or whatever moves it."""
        camera, captures = self._rig.camera, self._rig.captures
        x, y = (min(max(at, 0.0), size - 1.0) for at, size in zip(place_px, (camera.columns, camera.rows), strict=True))
        led = Led(x, y, captures.psf_distance_mm, captures.psf_led_mm)
        step_id = self._cell.step_ids[len(self._taken_px)]
        self._bench.stage.arrange(led, Occasion(step_id, self._writer.number(step_id), ""))
        return led

    def _ask_from(self, seen_px: Place, wanted_px: Place) -> None:
        """Have the LED brought from where it is seen to where it is wanted."""
        right, down = wanted_px[0] - seen_px[0], wanted_px[1] - seen_px[1]
        self._asked = self._ask((self._asked.x_px + right, self._asked.y_px + down))
        self._looks.clear()

    def _ask_inwards(self) -> None:
        """Where an aim has missed the sensor, begin again halfway to its middle."""
        (x, y), camera = self._cell.place_px, self._rig.camera
        halfway = ((x + camera.columns / 2) / 2, (y + camera.rows / 2) / 2)
        if (self._asked.x_px, self._asked.y_px) != halfway:
            self._asked = self._ask(halfway)

    def _next_phase(self) -> Place:
        self._nudges += 1
        shifts = CELL_PX * low_discrepancy(self._nudges + 1)
        (x, y), (right, down) = self._taken_px[0], shifts[-1] - shifts[0]
        return (x + float(right), y + float(down))

    def _wanted(self) -> Outline:
        return Outline((self._taken_px[0],), "wanted") if self._taken_px else self._cell.outline

    def _off(self, place_px: Place) -> Reading:
        """How far the LED is outside its cell, or outside the place of the cell's other brackets."""
        middle = self._taken_px[0] if self._taken_px else self._cell.place_px
        half = (_TOGETHER_PX, _TOGETHER_PX) if self._taken_px else self._cell.half_px
        off = max(abs(at - to) - most for at, to, most in zip(place_px, middle, half, strict=True))
        return Reading("LED outside its place", max(off, 0.0), None, 0.0, "px")

    def _movement(self) -> Reading:
        """The largest change over the last looks; unknown, and too large, before there are enough."""
        changes = [led_change(before, self._looks[-1], self._rig) for before in self._looks]
        largest = max(changes, key=lambda change: change.value)
        return largest if len(changes) == _STILL_LOOKS else replace(largest, value=math.inf)

    def _new_phase(self, place_px: Place) -> Reading:
        least = phase_distance_px(len(self._cell.step_ids))
        return Reading("new within the pattern", nearest_phase_px(place_px, self._taken_px), least, None, "px")

    def _where_next(self, readings: tuple[Reading, ...], place_px: Place) -> str:
        """Return what is to be done with the LED, if anything; a hand that follows it is told where to go."""
        _, _, off, movement, new = readings
        if not off.ok:
            wanted = self._taken_px[0] if self._taken_px else self._cell.place_px
            if movement.ok:
                self._ask_from(place_px, wanted)
            return f"{move_led(place_px, wanted)}."
        if not movement.ok:
            return "Let the LED rest."
        if not new.ok:
            self._ask_from(place_px, self._next_phase())
            return "A picture with the LED at this place within a pixel is there already. Nudge it by a pixel or so."
        return ""

    def _why_unseen(self, seen: bool, led: LedSeen, room: Reading) -> str:
        if not led.room.ok:
            return "The surroundings are nearly as bright as the LED. Darken the room."
        return why_not(room) if seen else "No LED is seen. Switch it on and bring it into the camera's view."
