"""People who are led: one who agrees, one who practises with a simulated hand, one at a terminal."""

from __future__ import annotations

import io
import json
import math
import sys
import time
from dataclasses import replace

import numpy as np
import pytest

from tests.guide.scripted import Scripted
from tests.simulation.toy import toy_truth
from udccal.arrangements import Arrangement, Dark, FlatLight, Led, Occasion
from udccal.cli.jobs.guided import Reported
from udccal.cli.jobs.terminal import TerminalPerson
from udccal.cli.output import Output
from udccal.errors import UdccalError
from udccal.guide.events import Answer, Reading, ReadingsEvent, StepEvent, VerdictEvent
from udccal.guide.people import Agreeing, Practising
from udccal.simulation.hand import Hand
from udccal.simulation.world import SimulatedWorld

STEP = StepEvent("wire/flat", "Even light", "Why.", "Do it.", "<svg/>", 1, 2, 3.0)
GOOD, BAD = Reading("evenness", 80.0, 15.0, None, "%"), Reading("evenness", 8.0, 15.0, None, "%")
ASKED = (Answer.go, Answer.skip)


def looked(reading: Reading, sentence: str = "") -> ReadingsEvent:
    return ReadingsEvent("wire/flat", (reading,), sentence)


def test_whoever_agrees_goes_on_only_where_all_is_in_order() -> None:
    person = Agreeing(Scripted())
    for event, expected in (
        (STEP, None),
        (looked(GOOD), Answer.go),
        (looked(GOOD, "The room is lit."), None),
        (looked(BAD), None),
        (VerdictEvent("wire/flat", False, "Refused.", ASKED), None),
        (VerdictEvent("wire/flat", True, "Captured.", ASKED), Answer.go),
    ):
        person.tell(event)
        assert person.answer(ASKED, 0.0) is expected
    assert person.answer((Answer.skip,), 0.0) is None


class Recorder:
    """A hand that notes what it is told."""

    def __init__(self) -> None:
        self.did: list[str] = []

    def mistake(self) -> None:
        self.did.append("mistake")

    def correct(self) -> None:
        self.did.append("correct")


def test_wrong_is_for_the_hand_and_no_answer_to_the_guide() -> None:
    hand, answers = Recorder(), [Answer.wrong, Answer.go, Answer.go]
    offers = []
    inner = Scripted(lambda event, offered: offers.append(offered) or answers.pop(0))
    person = Practising(inner, hand)
    person.tell(looked(GOOD))
    assert person.answer(ASKED, 0.0) is None
    assert hand.did == ["mistake"]
    assert person.answer(ASKED, 0.0) is Answer.go
    person.tell(VerdictEvent("wire/flat", False, "Refused.", ASKED))
    assert person.answer(ASKED, 0.0) is Answer.go
    assert hand.did == ["mistake", "correct"]
    assert offers == [(*ASKED, Answer.wrong), (*ASKED, Answer.wrong), ASKED]


@pytest.fixture
def world() -> SimulatedWorld:
    return SimulatedWorld(toy_truth())


def put(world: SimulatedWorld) -> Arrangement:
    return world._arrangement


def test_a_hand_aims_inexactly_and_the_same_each_time(world: SimulatedWorld) -> None:
    places = []
    for _ in range(2):
        hand, led = Hand(world), Led(60.0, 40.0, 2000.0, 2.3)
        hand.arrange(led, Occasion("psf/p00_s0", 0, ""))
        places.append(put(world))
        hand.arrange(led, Occasion("psf/p00_s0", 0, ""))
        assert put(world) == places[-1]
        assert 0 < abs(places[-1].x_px - 60.0) <= 0.02 * 128
        hand.arrange(replace(led, x_px=61.0), Occasion("psf/p00_s1", 1, ""))
        way = max(abs(61.0 - places[-1].x_px), abs(40.0 - places[-1].y_px))
        assert abs(put(world).x_px - 61.0) <= way / 2
    assert places[0] == places[1]


def test_a_hand_that_is_told_so_does_it_wrong_until_it_is_corrected(world: SimulatedWorld) -> None:
    hand, told = Hand(world), Occasion("wire/flat", 0, "")
    hand.mistake()  # nothing was asked for yet
    hand.arrange(FlatLight(), told)
    hand.mistake()
    assert put(world) == Dark()
    hand.arrange(FlatLight(), told)
    assert put(world) == Dark()
    hand.correct()
    hand.arrange(FlatLight(), told)
    assert put(world) == FlatLight()


def test_mistakes_with_an_led_take_turns(world: SimulatedWorld) -> None:
    hand = Hand(world)
    hand.arrange(Led(60.0, 40.0, 2000.0, 2.3), Occasion("psf/p00_s0", 0, ""))
    hand.mistake()
    assert isinstance(put(world), Led)
    assert np.hypot(put(world).x_px - 60.0, put(world).y_px - 40.0) > 3
    hand.mistake()
    assert put(world) == FlatLight()


def test_events_are_one_json_object_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    person = Reported(Output(events=True), Scripted())
    person.tell(STEP)
    person.tell(VerdictEvent("wire/flat", True, "Captured.", ASKED))
    first, second = (json.loads(line) for line in capsys.readouterr().out.splitlines())
    assert (first["event"], first["id"], first["number"], first["drawing"]) == ("step", "wire/flat", 1, "<svg/>")
    assert second["offered"] == ["go", "skip"]


class Typed(io.StringIO):
    """Lines typed at a terminal, or piped in."""

    terminal = False

    def isatty(self) -> bool:
        return self.terminal


def typed(monkeypatch: pytest.MonkeyPatch, lines: str, terminal: bool = False) -> TerminalPerson:
    stdin = Typed(lines)
    stdin.terminal = terminal
    monkeypatch.setattr(sys, "stdin", stdin)
    person = TerminalPerson(Output())
    for _ in range(500):  # its thread reads, up to the end
        if person._lines.qsize() > lines.count("\n"):
            break
        time.sleep(0.01)
    return person


def test_words_at_a_terminal(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    person = typed(monkeypatch, "\nSKIP\nback\nwhatever\n")
    person.tell(STEP)
    assert person.answer(ASKED, 0.1) is Answer.go
    assert person.answer(ASKED, 0.1) is Answer.skip
    assert person.answer(ASKED, 0.1) is None
    assert person.answer(ASKED, 0.1) is None
    said = capsys.readouterr().err
    assert "Step 1 of 2, 3 minutes left: Even light" in said
    assert "'back' is none of the answers: Enter, skip." in said
    assert "'whatever' is none of the answers" in said
    assert said.count("[Enter · skip]") == 1


def test_an_enter_typed_before_the_question_is_no_answer_and_a_word_is(monkeypatch: pytest.MonkeyPatch) -> None:
    person = typed(monkeypatch, "\n \nskip\n", terminal=True)
    person.tell(VerdictEvent("wire/flat", True, "Captured.", ASKED))
    assert person.answer(ASKED, 0.0) is Answer.skip
    # What a program pipes in is all typed ahead.
    person = typed(monkeypatch, "\n")
    person.tell(VerdictEvent("wire/flat", True, "Captured.", ASKED))
    assert person.answer(ASKED, 0.0) is Answer.go


def test_a_closed_input_is_said_only_where_an_answer_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    person = typed(monkeypatch, "")
    assert person.answer((Answer.skip,), 0.0) is None
    with pytest.raises(UdccalError, match="standard input is closed"):
        person.answer(ASKED, 0.1)


def test_whoever_agrees_lets_a_set_up_come_into_order_with_nobody_at_the_keys(monkeypatch: pytest.MonkeyPatch) -> None:
    closed = typed(monkeypatch, "")
    patient, impatient = Agreeing(closed), Agreeing(closed, set_up_s=0.0)
    for person in (patient, impatient):
        person.tell(STEP)
        person.tell(looked(BAD))
    assert patient.answer(ASKED, 0.1) is None
    with pytest.raises(UdccalError, match="standard input is closed"):
        impatient.answer(ASKED, 0.1)
    patient.tell(looked(GOOD))
    assert patient.answer(ASKED, 0.1) is Answer.go
    patient.tell(VerdictEvent("wire/flat", False, "Refused.", ASKED))
    with pytest.raises(UdccalError, match="standard input is closed"):
        patient.answer(ASKED, 3600.0)


def test_readings_are_printed_when_they_say_something_else(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    person = typed(monkeypatch, "")
    for value in (80.0, 81.0, 79.0):
        person.tell(looked(replace(GOOD, value=value)))
    person.tell(looked(BAD, "A shadow."))
    person.tell(looked(Reading("movement", math.inf, None, 1.0, "px"), "Hold it still."))
    said = capsys.readouterr().err
    assert "movement – ✗" in said
    assert said.count("evenness") == 2
    assert "evenness 8 % ✗" in said
    assert "A shadow." in said
