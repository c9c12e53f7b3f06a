"""Sessions in which a person has skipped something."""

from __future__ import annotations

import numpy as np
import pytest

from udccal.cameras.protocol import CameraIdentity, Frame, Region, Settings
from udccal.fitting.nominal import lacking
from udccal.rig import load_rig
from udccal.sessions.captured import SingleFrame
from udccal.sessions.schema import BoardSubject, DarkSubject, FlatSubject, LedSubject, TermName
from udccal.sessions.store import Session
from udccal.sessions.writer import SessionWriter

_FRAME = SingleFrame(Frame(np.full((8, 12), 70, np.uint16), Settings(0.01, 0.0, Region(0, 0, 12, 8)), 0.0, 0, True))


def _led(x_px: float) -> LedSubject:
    return LedSubject(x_px=x_px, y_px=300.0, distance_mm=2000.0, diameter_mm=2.0)


def _board(parallel: bool) -> BoardSubject:
    return BoardSubject(
        columns=12, rows=9, square_mm=50.0, marker_mm=37.5, dictionary="DICT_5X5_1000", parallel_to_panel=parallel
    )


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Session:
    """A session with all that the fits need and no more, of tiny frames."""
    folder, rig = tmp_path_factory.mktemp("whole") / "session", load_rig("lg55-reduced")
    picture = np.zeros((rig.panel.rows, rig.panel.columns, 3), np.uint8)
    with SessionWriter.create(folder, rig, CameraIdentity("a", "b", "c", "d")) as writer:

        def add(step_id: str, subject: object) -> None:
            writer.add_step(step_id, step_id.partition("/")[0], subject, [_FRAME])

        for index in range(3):
            add(f"noise/flat_{index}", FlatSubject())
            add(f"psf/p0{index}_s0", _led(100.0 * index))
        add("psf/p00_s1", _led(1.0))
        add("noise/dark_stack", DarkSubject())
        add("noise/dark_0", DarkSubject())
        add("noise/dark_1", DarkSubject())
        add("geometry/panel", _board(parallel=True))
        add("geometry/view_0", _board(parallel=False))
        add("wire/flat", FlatSubject())
        add("wire/dark", DarkSubject())
        add("backscatter/dark", DarkSubject())
        add("backscatter/white", writer.store_picture("backscatter/white", picture, "white"))
        for index in range(6):
            step_id = f"backscatter/picture_{index}"
            add(step_id, writer.store_picture(step_id, picture, "picture"))
    return Session.open(folder)


def without(whole: Session, *step_ids: str) -> Session:
    steps = tuple(step for step in whole.manifest.steps if step.id not in step_ids)
    assert len(steps) == len(whole.manifest.steps) - len(step_ids)
    return Session(whole.path, whole.manifest.model_copy(update={"steps": steps}))


@pytest.mark.parametrize("term", ["noise", "geometry", "wire", "psf", "backscatter"])
def test_nothing_lacks_in_a_whole_session(whole: Session, term: TermName) -> None:
    assert lacking(whole, term) == ""


@pytest.mark.parametrize(
    ("step_ids", "said"),
    [
        (["noise/dark_1"], "1 more exposures in the dark"),
        (["noise/flat_0", "noise/flat_1"], "2 more exposures of the even light"),
        (["geometry/panel"], "a view of the board on the jig, parallel to the display"),
        (["wire/dark"], "wire/dark"),
        (["wire/flat"], "wire/flat"),
        (["psf/p02_s0"], "1 more places of the LED"),
        (["backscatter/white"], "backscatter/white"),
        (["backscatter/dark", "backscatter/picture_3"], "backscatter/dark, 1 more pictures beside the white one"),
    ],
    ids=str,
)
def test_what_was_skipped_is_named(whole: Session, step_ids: list[str], said: str) -> None:
    term = step_ids[0].partition("/")[0]
    assert lacking(without(whole, *step_ids), term) == said


@pytest.mark.parametrize("step_id", ["noise/dark_stack", "geometry/view_0", "psf/p00_s1"])
def test_what_a_fit_can_do_without_may_be_skipped(whole: Session, step_id: str) -> None:
    assert lacking(without(whole, step_id), step_id.partition("/")[0]) == ""
