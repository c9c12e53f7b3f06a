"""Leads a person through a capture with the command: who that is, what is written for programs, and how it ends."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import final

from udccal.benches.bench import CaptureBench, simulated_bench, simulated_rig
from udccal.cameras.protocol import Frame
from udccal.cli.jobs.capture import Wanted, open_session, refuse_unknown
from udccal.cli.output import Output
from udccal.guide.capture import lead_capture
from udccal.guide.events import Answer, DoneEvent, Event, Outline, Person, Quit, RequestEvent
from udccal.guide.people import Agreeing, Practising
from udccal.rig import RigDescription
from udccal.simulation.hand import Hand


@final
class Reported:
    """Implements ``Person``: writes each event as one JSON object a line on standard output, and passes it on."""

    def __init__(self, output: Output, person: Person) -> None:
        self._output, self._person = output, person

    def tell(self, event: Event) -> None:
        """Write the event and pass it on."""
        self._output.line(event)
        self._person.tell(event)

    def look(self, frame: Frame, outlines: tuple[Outline, ...]) -> None:
        """Pass the frame on."""
        self._person.look(frame, outlines)

    def answer(self, offered: tuple[Answer, ...], wait_s: float) -> Answer | None:
        """Return the person's answer."""
        return self._person.answer(offered, wait_s)


@contextmanager
def practice_bench(
    rig: RigDescription, seed: int, noise_seed: int | None, person: Person
) -> Iterator[tuple[CaptureBench, Person]]:
    """Open a simulated rig with a simulated hand, and return it with the person who tells the hand what to do."""
    world = simulated_rig(rig, seed, noise_seed)
    hand = Hand(world)
    with simulated_bench(world) as bench:
        yield replace(bench, stage=hand), Practising(person, hand)


def led_by(output: Output, person: Person, agree: bool) -> Person:
    """Return the person as ``--yes`` and ``--json-events`` have it."""
    agreeing = Agreeing(person) if agree else person
    return Reported(output, agreeing) if output.events else agreeing


def show_on_panel(person: Person, sentence: str) -> bool:
    """Ask a person to show a picture on the panel, and return True when it is done.

    Raises:
        Quit: when the person stops instead.
    """
    offered = (Answer.go, Answer.quit)
    person.tell(RequestEvent(f"{sentence} Go on when it is done.", offered))
    while (answer := person.answer(offered, 3600.0)) is None:
        pass
    if answer is Answer.quit:
        raise Quit
    return True


def capture_led(output: Output, bench: CaptureBench, person: Person, wanted: Wanted) -> DoneEvent:
    """Capture a session with a person who is led.

    Returns:
        how it ended.

    Raises:
        UdccalError: when something is wrong that no person at the rig can mend.
        SessionError: as ``open_session`` and ``refuse_unknown`` do.
    """
    with open_session(output, bench, wanted) as writer:
        done = lead_capture(writer, bench, person, wanted.terms)
        if not done.stopped:
            refuse_unknown(writer)
        return done
