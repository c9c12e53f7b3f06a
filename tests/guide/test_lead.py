"""A person is led through whole captures of a painted rig: prompts, mistakes, skip, back, again, quit, resume."""

from __future__ import annotations

from pathlib import Path

import pytest

from procedures.aiming import board_facing
from procedures.geometry import board_spec
from tests.guide.painted import PaintedRig, painted_bench, painted_rig
from tests.guide.scripted import Reaction, Scripted
from udccal.arrangements import Board, Dark, FlatLight, Led
from udccal.benches.capture import capture, capture_term
from udccal.errors import CaptureError
from udccal.guide.capture import guided_steps, lead_capture
from udccal.guide.events import Answer, Event, ProgressEvent, ReadingsEvent, StepEvent, VerdictEvent, in_order
from udccal.rig import load_rig
from udccal.sessions.schema import TermName
from udccal.sessions.store import Session
from udccal.sessions.writer import SessionWriter


def led(
    folder: Path,
    terms: list[TermName],
    react: Reaction = lambda event, offered: None,
    painted: PaintedRig | None = None,
    again: tuple[str, ...] = (),
) -> Scripted:
    painted = painted or PaintedRig(painted_rig(psf_columns=2, psf_rows=1))
    bench, person = painted_bench(painted), Scripted(react)
    with SessionWriter.create_or_resume(folder, bench.rig, bench.camera.identity, now=bench.now) as writer:
        writer.capture_again(again)
        done = lead_capture(writer, bench, person, terms)
    assert person.done is done
    return person


def counted(person: Scripted) -> list[int]:
    return [event.frames for event in person.events if isinstance(event, ProgressEvent)]


@pytest.mark.medium
def test_a_whole_rig_takes_at_most_40_prompts(tmp_path: Path) -> None:
    rig, real = painted_rig(4, psf_shifts=1, board_views=3), load_rig("lg55-aca2040")
    assert [step.id for step in guided_steps(rig)] == [step.id for step in guided_steps(real)]
    person = led(tmp_path, ["noise", "geometry", "wire", "psf", "backscatter"], painted=PaintedRig(rig))
    assert person.done.complete
    assert person.prompts <= 40
    session = Session.open(tmp_path)
    assert {step.id for step in session.manifest.steps} == {i for step in guided_steps(rig) for i in step.step_ids}
    steps = [event for event in person.events if isinstance(event, StepEvent)]
    assert [event.number for event in steps] == list(range(1, steps[0].of + 1))
    left = [event.minutes_left for event in steps]
    assert left == sorted(left, reverse=True)
    assert all(event.why and event.instruction.endswith(".") and event.drawing.startswith("<svg") for event in steps)


def test_frames_are_counted(tmp_path: Path) -> None:
    person = led(tmp_path, ["noise"])
    counted = [event for event in person.events if isinstance(event, ProgressEvent)]
    assert [event.frames for event in counted if event.step_id == "noise/flat_stack"] == [3, 5, 7, 9, 11]
    assert all(event.frames <= event.of for event in counted)
    assert person.prompts == 4  # two set-ups and two verdicts


def test_the_place_of_an_led_is_measured(tmp_path: Path) -> None:
    painted = PaintedRig(painted_rig(psf_columns=2, psf_rows=1, psf_shifts=3), offset_px=3.3)
    led(tmp_path, ["psf"], painted=painted)
    session = Session.open(tmp_path)
    assert [step.id for step in session.steps("psf")] == [f"psf/p0{p}_s{s}" for p in (0, 1) for s in (0, 1, 2)]
    first = session.step("psf/p00_s0").subject
    asked = next(each for each in painted.asked if isinstance(each, Led))
    assert (first.x_px - asked.x_px, first.y_px - asked.y_px) == pytest.approx((3.3, 3.3), abs=0.2)
    for step in session.steps("psf"):
        region = step.captures[0].region
        assert 0 < step.subject.x_px - region.x < region.columns
        assert 0 < step.subject.y_px - region.y < region.rows


@pytest.mark.parametrize(
    ("put", "sentence"),
    [
        (Led(60.0, 150.0, 2000.0, 1.15), "Move the LED so that its image goes"),
        (FlatLight(), "The surroundings are nearly as bright as the LED. Darken the room."),
        (Dark(), "No LED is seen."),
    ],
    ids=["wrong place", "room lit", "LED off"],
)
def test_a_wrong_led_is_not_captured_and_the_person_is_told_why(tmp_path: Path, put: object, sentence: str) -> None:
    painted = PaintedRig(painted_rig(psf_columns=2, psf_rows=1))

    def react(event: Event, offered: tuple[Answer, ...]) -> Answer | None:
        if painted.frames_taken > 20:
            painted.put = None
        return None

    painted.put = put
    person = led(tmp_path, ["psf"], react, painted)
    assert any(said.startswith(sentence) for said in person.sentences("psf/p00"))
    assert person.done.complete


def test_a_moving_led_is_not_captured(tmp_path: Path) -> None:
    painted = PaintedRig(painted_rig(psf_columns=1, psf_rows=1))
    painted.drift_px = 0.2

    def react(event: Event, offered: tuple[Answer, ...]) -> Answer | None:
        if painted.frames_taken > 40:
            painted.drift_px = 0.0
        return None

    person = led(tmp_path, ["psf"], react, painted)
    assert "Let the LED rest." in person.sentences("psf/p00")
    assert person.done.complete


def test_an_led_that_moves_while_its_frames_are_taken_is_not_captured(tmp_path: Path) -> None:
    painted = PaintedRig(painted_rig(psf_columns=1, psf_rows=1))

    def react(event: Event, offered: tuple[Answer, ...]) -> Answer | None:
        if isinstance(event, ReadingsEvent):
            about_to_be_taken = in_order(event.readings, event.sentence)
            painted.drift_px = 0.13 if about_to_be_taken and painted.frames_taken < 30 else 0.0
        return None

    person = led(tmp_path, ["psf"], react, painted)
    assert any("found that its picture changed by" in said for said in person.sentences("psf/p00"))
    assert person.done.complete


@pytest.mark.parametrize(
    ("term", "step_id", "put", "sentence"),
    [
        ("wire", "wire/flat", Dark(), "Expected to see the light"),
        ("wire", "wire/flat", Led(100.0, 100.0, 2000.0, 1.15), "Expected an even light"),
        ("wire", "wire/dark", FlatLight(), "Expected a dark frame"),
        pytest.param("geometry", "geometry/panel", FlatLight(), "Expected to find at least", marks=pytest.mark.medium),
    ],
)
def test_a_wrong_set_up_is_refused(tmp_path: Path, term: TermName, step_id: str, put: object, sentence: str) -> None:
    painted = PaintedRig(painted_rig(4 if term == "geometry" else 8, board_views=1))
    before: list[str] = []

    def react(event: Event, offered: tuple[Answer, ...]) -> Answer | None:
        if isinstance(event, ReadingsEvent) and event.step_id == step_id and not before:
            painted.put = put
            before.append("went on all the same")
            return Answer.go
        if isinstance(event, VerdictEvent) and not event.ok:
            painted.put = None
            return Answer.go
        return None

    person = led(tmp_path, [term], react, painted)
    (refused,) = (event for event in person.events if isinstance(event, VerdictEvent) and not event.ok)
    assert sentence in refused.sentence
    assert refused.offered == (Answer.go, Answer.skip, Answer.back, Answer.quit)
    assert person.done.complete


@pytest.mark.parametrize("guided", [True, False])
def test_light_that_only_the_dark_step_shows_was_in_the_pictures_before_it_too(tmp_path: Path, guided: bool) -> None:
    painted = PaintedRig(painted_rig())
    painted.leak_per_s = 20.0

    def react(event: Event, offered: tuple[Answer, ...]) -> Answer | None:
        if not isinstance(event, VerdictEvent) or event.ok:
            return None
        assert Session.open(tmp_path).steps("backscatter") == ()
        painted.leak_per_s = 0.0
        return Answer.go

    if guided:
        person = led(tmp_path, ["backscatter"], react, painted)
        assert "Expected a dark frame" in " ".join(person.sentences("backscatter/white"))
    else:
        with pytest.raises(CaptureError, match="Expected a dark frame"):
            capture(tmp_path, painted_bench(painted), "backscatter")
        painted.leak_per_s = 0.0
        capture(tmp_path, painted_bench(painted), "backscatter")
    session = Session.open(tmp_path)
    white = next(step for step in session.steps("backscatter") if step.id == "backscatter/white")
    # Without the room's light, white takes three times as long to reach its level.
    assert white.captures[0].exposure_s > 0.05


def test_pictures_that_a_dark_step_has_confirmed_stay(tmp_path: Path) -> None:
    """Where only the dark step is captured again, and finds light, the light came later."""
    painted = PaintedRig(painted_rig())
    whole = {step.id for step in capture(tmp_path, painted_bench(painted), "backscatter").manifest.steps}
    painted.leak_per_s = 20.0
    bench = painted_bench(painted)
    with SessionWriter.create_or_resume(tmp_path, bench.rig, bench.camera.identity, now=bench.now) as writer:
        writer.capture_again(["backscatter/dark"])
        with pytest.raises(CaptureError, match="Expected a dark frame"):
            capture_term(writer, bench, "backscatter", lambda done, total: None)
    assert {step.id for step in Session.open(tmp_path).manifest.steps} == whole


@pytest.mark.medium
def test_a_missing_board_is_told(tmp_path: Path) -> None:
    painted = PaintedRig(painted_rig(4, board_views=2))

    def react(event: Event, offered: tuple[Answer, ...]) -> Answer | None:
        if isinstance(event, StepEvent | ReadingsEvent) and getattr(event, "step_id", "") == "geometry/views":
            painted.put = None if painted.frames_taken > 60 else FlatLight()
        return None

    person = led(tmp_path, ["geometry"], react, painted)
    assert any("of the board's corners are seen" in said for said in person.sentences("geometry/views"))
    assert person.done.complete


@pytest.mark.medium
def test_a_board_beside_the_jig_is_never_in_order(tmp_path: Path) -> None:
    """Its view defines the panel's frame: whoever agrees to all that is in order must not agree to this."""
    painted = PaintedRig(painted_rig(4))
    spec = board_spec(painted.rig)
    middle = tuple((size - 1) / 2 for size in (painted.rig.camera.columns, painted.rig.camera.rows))
    leaning = board_facing(painted.rig, spec, middle, 700.0, (0.0, 0.0, 0.0))
    looks = 0

    def react(event: Event, offered: tuple[Answer, ...]) -> Answer | None:
        nonlocal looks
        painted.put = leaning if looks < 6 else None
        if isinstance(event, ReadingsEvent) and event.step_id == "geometry/panel":
            looks += 1
            assert looks > 5 or not in_order(event.readings, event.sentence)
        return Answer.quit if isinstance(event, StepEvent) and event.step_id == "geometry/views" else None

    person = led(tmp_path, ["geometry"], react, painted)
    assert "The board leans by 17 degrees against the display. Lay it flat on the jig." in person.sentences(
        "geometry/panel"
    )
    assert "geometry/panel" in {step.id for step in Session.open(tmp_path).manifest.steps}


@pytest.mark.medium
def test_the_same_view_again_is_not_taken(tmp_path: Path) -> None:
    painted = PaintedRig(painted_rig(4, board_views=3))

    def react(event: Event, offered: tuple[Answer, ...]) -> Answer | None:
        views = [step for step in painted.asked if hasattr(step, "spec") and not step.parallel_to_panel]
        done = isinstance(event, ReadingsEvent) and "Such a view is there already" in event.sentence
        painted.put = None if done or not views else views[0]
        return Answer.quit if done else None

    person = led(tmp_path, ["geometry"], react, painted)
    assert person.done.stopped
    assert 1 <= len(Session.open(tmp_path).steps("geometry")) - 1 < 3


def test_skip_leaves_out_and_what_needs_it_cannot_be_captured(tmp_path: Path) -> None:
    def react(event: Event, offered: tuple[Answer, ...]) -> Answer | None:
        if isinstance(event, ReadingsEvent) and event.step_id == "wire/flat":
            return Answer.skip
        return Answer.skip if offered == (Answer.skip, Answer.back, Answer.quit) else None

    person = led(tmp_path, ["wire"], react)
    assert not person.done.complete
    assert not person.done.stopped
    assert person.done.sentence.startswith("Captured, without wire/flat, wire/dark.")
    assert person.sentences("wire/dark") == [
        "This step takes up the exposure of wire/flat, which was not captured. Go back to it."
    ]
    assert Session.open(tmp_path).manifest.steps == ()


def test_back_and_again_capture_a_step_once_more(tmp_path: Path) -> None:
    todo = [Answer.again, Answer.back]

    def react(event: Event, offered: tuple[Answer, ...]) -> Answer | None:
        if isinstance(event, VerdictEvent) and event.step_id == "wire/flat" and len(todo) == 2:
            return todo.pop(0)
        if isinstance(event, ReadingsEvent) and event.step_id == "wire/dark" and todo:
            return todo.pop(0)
        return None

    person = led(tmp_path, ["wire"], react)
    assert person.visited == ["wire/flat", "wire/flat", "wire/dark", "wire/flat", "wire/dark"]
    assert [step.id for step in Session.open(tmp_path).steps("wire")] == ["wire/flat", "wire/dark"]


def test_a_step_that_is_left_after_back_stays_as_it_was(tmp_path: Path) -> None:
    went = []

    def react(event: Event, offered: tuple[Answer, ...]) -> Answer | None:
        if isinstance(event, ReadingsEvent) and event.step_id == "wire/dark" and not went:
            went.append(Session.open(tmp_path).step("wire/flat"))
            return Answer.back
        if isinstance(event, ReadingsEvent) and event.step_id == "wire/flat" and went:
            return Answer.skip
        return None

    person = led(tmp_path, ["wire"], react)
    assert person.done.complete
    assert Session.open(tmp_path).step("wire/flat") == went[0]


def leaves(painted: PaintedRig, brackets: int, answer: Answer) -> Reaction:
    """Answer once so many brackets of an LED are taken, then quit: the LED is asked to another place after each."""
    said: list[Answer] = []

    def react(event: Event, offered: tuple[Answer, ...]) -> Answer | None:
        if len(set(painted.asked)) <= brackets:
            return None
        said.append(Answer.quit if said else answer)
        return said[-1]

    return react


@pytest.mark.parametrize("answer", [Answer.skip, Answer.back, Answer.quit])
def test_a_cell_that_is_left_while_it_is_captured_again_stays_as_it_was(tmp_path: Path, answer: Answer) -> None:
    led(tmp_path, ["psf"])
    before = Session.open(tmp_path).manifest
    painted = PaintedRig(before.rig, offset_px=3.0)
    person = led(tmp_path, ["psf"], leaves(painted, 1, answer), painted, again=("psf/p00_s0",))
    assert counted(person) == [2]  # one bracket was taken anew
    assert Session.open(tmp_path).manifest.steps == before.steps
    assert led(tmp_path, ["psf"]).visited == []


def test_a_cell_that_is_captured_again_is_exchanged_as_a_whole(tmp_path: Path) -> None:
    led(tmp_path, ["psf"])
    before = Session.open(tmp_path)
    painted = PaintedRig(before.manifest.rig, offset_px=3.0)
    person = led(tmp_path, ["psf"], painted=painted, again=("psf/p00_s0",))
    assert counted(person) == [2, 4]
    after = {step.id: step for step in Session.open(tmp_path).manifest.steps}
    assert sorted(after) == sorted(step.id for step in before.manifest.steps)
    new = {step_id for step_id, step in after.items() if step != before.step(step_id)}
    assert new == {"psf/p00_s0", "psf/p00_s1"}


def test_what_is_left_of_a_half_done_cell_leaves_when_it_begins_anew(tmp_path: Path) -> None:
    for brackets, held in ((2, ["psf/p00_s0", "psf/p00_s1"]), (1, ["psf/p00_s0"])):
        painted = PaintedRig(painted_rig(psf_columns=1, psf_rows=1, psf_shifts=3))
        led(tmp_path, ["psf"], leaves(painted, brackets, Answer.quit), painted)
        assert [step.id for step in Session.open(tmp_path).steps("psf")] == held


def test_a_refusal_leaves_what_is_captured_again_as_it_was_asked_for(tmp_path: Path) -> None:
    led(tmp_path, ["noise"])
    before = Session.open(tmp_path)
    painted = PaintedRig(before.manifest.rig)
    painted.put = FlatLight()

    def react(event: Event, offered: tuple[Answer, ...]) -> Answer | None:
        if isinstance(event, VerdictEvent) and not event.ok:
            painted.put = None
        return Answer.go

    person = led(tmp_path, ["noise"], react, painted, again=("noise/dark_1",))
    assert "Expected a dark frame" in " ".join(person.sentences("noise/dark_stack"))
    assert person.done.complete
    after = Session.open(tmp_path)
    new = [step.id for step in after.manifest.steps if step != before.step(step.id)]
    assert new == ["noise/dark_1"]


def test_quit_keeps_what_is_captured_and_the_next_run_continues(tmp_path: Path) -> None:
    def react(event: Event, offered: tuple[Answer, ...]) -> Answer | None:
        return Answer.quit if isinstance(event, VerdictEvent) else None

    person = led(tmp_path, ["wire"], react)
    assert person.done.stopped
    assert person.visited == ["wire/flat"]
    assert led(tmp_path, ["wire"]).visited == ["wire/dark"]
    assert led(tmp_path, ["wire"]).visited == []


@pytest.mark.medium
def test_views_held_before_an_interruption_count_as_they_were_held(tmp_path: Path) -> None:
    """Held as before, the board is refused after a restart too: its pose was read from the session's picture."""
    painted = PaintedRig(painted_rig(4, board_views=3))

    def held() -> list[Board]:
        boards = [step for step in painted.asked if isinstance(step, Board) and not step.parallel_to_panel]
        return list(dict.fromkeys(boards))

    first = led(tmp_path, ["geometry"], lambda event, offered: Answer.quit if len(held()) > 1 else None, painted)
    assert first.done.stopped

    def again(event: Event, offered: tuple[Answer, ...]) -> Answer | None:
        done = isinstance(event, ReadingsEvent) and "Such a view is there already" in event.sentence
        painted.put = held()[0]
        return Answer.quit if done else None

    assert led(tmp_path, ["geometry"], again, painted).done.stopped
    assert len(Session.open(tmp_path).steps("geometry")) == 2
