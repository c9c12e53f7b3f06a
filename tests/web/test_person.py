"""Questions and answers between a capture and its windows."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

from tests.guide.painted import PaintedRig, painted_bench, painted_rig
from tests.web.capture import DRAWING, READY, SAMPLING, VERDICT
from udccal.cameras.protocol import Frame
from udccal.guide.capture import lead_capture
from udccal.guide.events import (
    Answer,
    DoneEvent,
    Event,
    Outline,
    Person,
    ProgressEvent,
    ReadingsEvent,
    RequestEvent,
    StepEvent,
    VerdictEvent,
)
from udccal.sessions.writer import SessionWriter
from udccal.web.lead import LAPSE_S, Lead
from udccal.web.person import Reception, WebPerson

STEP = StepEvent("psf/led-1", "LED", "It tells the blur.", "Hold the LED.", DRAWING, 1, 2, 8.0)
VERDICT_EVENT = VerdictEvent("psf/led-1", True, "Captured.", VERDICT)
MINE, OTHER = "a" * 32, "b" * 32


@pytest.fixture
def person() -> WebPerson:
    return WebPerson(SAMPLING)


def asked(person: WebPerson, offered: tuple[Answer, ...] = READY) -> int:
    """Offer answers without waiting, and return the number of the question."""
    assert person.answer(offered, 0.0) is None
    question = person.news(MINE, 0, 0, 0.0).shown.question
    assert question is not None
    assert question.offered == offered
    return question.number


def test_it_is_a_person(person: WebPerson) -> None:
    assert isinstance(person, Person)


def test_an_answer_reaches_the_capture_that_waits(person: WebPerson) -> None:
    question = asked(person)
    threading.Timer(0.1, person.give, (MINE, question, Answer.go)).start()
    assert person.answer(READY, 10.0) is Answer.go


def test_an_answer_between_two_short_waits_is_kept(person: WebPerson) -> None:
    question = asked(person)
    assert person.give(MINE, question, Answer.skip) is Reception.taken
    assert person.answer(READY, 0.0) is Answer.skip
    assert person.answer(READY, 0.0) is None


def test_a_question_stays_the_same_while_the_same_is_offered(person: WebPerson) -> None:
    assert asked(person) == asked(person)
    assert asked(person) != asked(person, VERDICT)


def test_a_second_touch_answers_nothing(person: WebPerson) -> None:
    question = asked(person)
    assert person.give(MINE, question, Answer.go) is Reception.taken
    assert person.give(MINE, question, Answer.go) is Reception.late
    assert person.answer(READY, 0.0) is Answer.go
    asked(person)
    assert person.give(MINE, question, Answer.go) is Reception.late


def test_what_was_not_offered_is_no_answer(person: WebPerson) -> None:
    assert person.give(MINE, 0, Answer.go) is Reception.late
    question = asked(person, (Answer.go, Answer.quit))
    assert person.give(MINE, question, Answer.again) is Reception.late
    assert person.give(MINE, question + 1, Answer.go) is Reception.late
    assert person.answer((Answer.go, Answer.quit), 0.0) is None


@pytest.mark.parametrize("event", [STEP, VERDICT_EVENT, DoneEvent(True, False, "All.")])
def test_an_answer_that_the_capture_has_not_taken_ends_with_its_step(
    person: WebPerson, event: StepEvent | VerdictEvent | DoneEvent
) -> None:
    person.tell(STEP)
    person.give(MINE, asked(person), Answer.skip)
    person.tell(event)
    assert person.answer(READY, 0.0) is None


def test_a_step_clears_what_the_last_one_showed(person: WebPerson) -> None:
    person.tell(STEP)
    person.tell(ReadingsEvent(STEP.id, (), "Move it."))
    person.tell(ProgressEvent(STEP.id, 1, 2))
    shown = person.news(MINE, 0, 0, 0.0).shown
    assert shown.readings is not None
    assert shown.progress is not None
    person.tell(VERDICT_EVENT)
    assert person.news(MINE, 0, 0, 0.0).shown.verdict == VERDICT_EVENT
    person.tell(STEP)
    shown = person.news(MINE, 0, 0, 0.0).shown
    assert (shown.step, shown.readings, shown.progress, shown.verdict) == (STEP, None, None, None)


def test_a_request_is_shown_until_it_is_answered(person: WebPerson) -> None:
    person.tell(STEP)
    person.tell(ReadingsEvent(STEP.id, (), "Move it."))
    request = RequestEvent("Show a.png.", (Answer.go, Answer.quit))
    person.tell(request)
    shown = person.news(MINE, 0, 0, 0.0).shown
    assert (shown.request, shown.readings, shown.verdict) == (request, None, None)
    person.give(MINE, asked(person, request.offered), Answer.go)
    assert person.answer(request.offered, 0.0) is Answer.go
    assert person.news(MINE, 0, 0, 0.0).shown.request is None


def test_news_come_when_something_happens_and_not_before(person: WebPerson) -> None:
    version = person.news(MINE, 0, 0, 10.0).version
    assert person.news(MINE, version, 0, 0.1).version == version
    threading.Timer(0.1, person.tell, (STEP,)).start()
    assert person.news(MINE, version, 0, 10.0).shown.step == STEP


class Clicking:
    """A window's person who clicks while the last frames of a step that goes by itself are taken."""

    def __init__(self, clicked: Answer) -> None:
        self.inner, self.clicked = WebPerson(SAMPLING), clicked
        self.receptions: list[Reception] = []
        self.visited: list[str] = []

    def tell(self, event: Event) -> None:
        self.inner.tell(event)
        if isinstance(event, StepEvent):
            self.visited.append(event.id)
        if isinstance(event, ProgressEvent) and event.frames == event.of and not self.receptions:
            question = self.inner.news(MINE, 0, 0, 0.0).shown.question
            assert question is not None
            self.receptions.append(self.inner.give(MINE, question.number, self.clicked))

    def look(self, frame: Frame, outlines: tuple[Outline, ...]) -> None:
        self.inner.look(frame, outlines)

    def answer(self, offered: tuple[Answer, ...], wait_s: float) -> Answer | None:
        return self.inner.answer(offered, wait_s)


@pytest.mark.parametrize(
    ("clicked", "after"),
    [
        (Answer.quit, []),
        (Answer.back, ["psf/p00", "psf/p01"]),
        (Answer.again, ["psf/p00", "psf/p01"]),
        (Answer.skip, ["psf/p01"]),
    ],
)
def test_a_click_during_the_last_frames_of_a_step_is_obeyed(tmp_path: Path, clicked: Answer, after: list[str]) -> None:
    bench, person = painted_bench(PaintedRig(painted_rig(psf_columns=2, psf_rows=1))), Clicking(clicked)
    with SessionWriter.create(tmp_path / "s", bench.rig, bench.camera.identity, now=bench.now) as writer:
        done = lead_capture(writer, bench, person, ["psf"])
    assert person.receptions == [Reception.taken]
    assert person.visited == ["psf/p00", *after]
    assert done.stopped is (clicked is Answer.quit)
    assert done.complete is not done.stopped


def test_the_first_window_that_answers_leads_and_others_watch(person: WebPerson) -> None:
    question = asked(person)
    assert person.news(OTHER, 0, 0, 0.0).may_answer
    assert person.give(MINE, question, Answer.go) is Reception.taken
    assert person.answer(READY, 0.0) is Answer.go
    assert not person.news(OTHER, 0, 0, 0.0).may_answer
    assert person.give(OTHER, asked(person), Answer.quit) is Reception.watches
    assert person.give(MINE, asked(person), Answer.go) is Reception.taken


def test_a_late_answer_does_not_take_the_lead(person: WebPerson) -> None:
    assert person.give(OTHER, asked(person) + 1, Answer.go) is Reception.late
    assert person.give(MINE, asked(person), Answer.go) is Reception.taken


def test_a_window_that_is_gone_for_long_leads_no_more() -> None:
    now_s = 0.0
    lead = Lead(lambda: now_s)
    assert lead.allows(OTHER)
    lead.take(MINE)
    now_s = LAPSE_S - 1.0
    assert not lead.allows(OTHER)
    lead.heard(OTHER)
    lead.heard(MINE)
    now_s = 2.0 * LAPSE_S - 2.0
    assert not lead.allows(OTHER)
    now_s = 2.0 * LAPSE_S
    assert lead.allows(OTHER)
    lead.take(OTHER)
    assert not lead.allows(MINE)
