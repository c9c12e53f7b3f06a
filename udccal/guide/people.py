"""People who are led in other ways than by their own answers alone: one who agrees, and one who practises."""

from __future__ import annotations

import time
from typing import Final, Protocol, final, runtime_checkable

from udccal.arrangements import Arrangement, Occasion
from udccal.cameras.protocol import Frame
from udccal.guide.events import Answer, Event, Outline, Person, ReadingsEvent, StepEvent, VerdictEvent, in_order

_SET_UP_S: Final = 300.0


@final
class ByHand:
    """Implements ``udccal.arrangements.Stage`` for a real rig: the person who is led sets everything up."""

    def arrange(self, arrangement: Arrangement, occasion: Occasion) -> None:
        """Do nothing: the person reads what to set up, and the camera shows when it is there."""


@final
class Agreeing:
    """Implements ``Person``: goes on by itself wherever all is in order, and asks another person where it is not.

    A set-up has some time to come into order by itself, as one does whose movement the first looks do not know yet.
    Whoever says something meanwhile is heard, but nobody has to be there.
    """

    def __init__(self, person: Person, set_up_s: float = _SET_UP_S) -> None:
        """Args:
        person: who is asked.
        set_up_s: how long after a step has begun its looks wait for nobody.
        """
        self._person, self._set_up_s = person, set_up_s
        self._in_order = self._looking = False
        self._until_s = 0.0

    def tell(self, event: Event) -> None:
        """Pass the event on."""
        self._looking = isinstance(event, ReadingsEvent)
        if isinstance(event, StepEvent):
            self._until_s = time.monotonic() + self._set_up_s
        match event:
            case ReadingsEvent(readings=readings, sentence=sentence):
                self._in_order = in_order(readings, sentence)
            case VerdictEvent(ok=ok):
                self._in_order = ok
            case _:
                self._in_order = False
        self._person.tell(event)

    def look(self, frame: Frame, outlines: tuple[Outline, ...]) -> None:
        """Pass the frame on."""
        self._person.look(frame, outlines)

    def answer(self, offered: tuple[Answer, ...], wait_s: float) -> Answer | None:
        """Answer ``go`` where all is in order."""
        if self._in_order and Answer.go in offered:
            return Answer.go
        if not self._looking or time.monotonic() >= self._until_s:
            return self._person.answer(offered, wait_s)
        answer = self._person.answer(offered, 0.0)
        if answer is None:
            time.sleep(wait_s)
        return answer


@runtime_checkable
class Practised(Protocol):
    """What a person practises on: it can be told to do something wrong, and to mend it."""

    def mistake(self) -> None:
        """Set up something wrong."""
        ...

    def correct(self) -> None:
        """Set up as asked what is asked for next."""
        ...


@final
class Practising:
    """Implements ``Person``: while a step is set up, the further answer ``wrong`` has the simulated hand do it wrong.

    The mistake stands until the person answers anything else but ``go``, or tries again after a refusal.
    """

    def __init__(self, person: Person, hand: Practised) -> None:
        self._person, self._hand = person, hand
        self._after = False
        self._refused = False

    def tell(self, event: Event) -> None:
        """Pass the event on."""
        if isinstance(event, VerdictEvent):
            self._refused = not event.ok
        self._after = isinstance(event, VerdictEvent)
        self._person.tell(event)

    def look(self, frame: Frame, outlines: tuple[Outline, ...]) -> None:
        """Pass the frame on."""
        self._person.look(frame, outlines)

    def answer(self, offered: tuple[Answer, ...], wait_s: float) -> Answer | None:
        """Return the person's answer; ``wrong`` is carried out here and is no answer to the guide."""
        answer = self._person.answer(offered if self._after else (*offered, Answer.wrong), wait_s)
        if answer is Answer.wrong:
            self._hand.mistake()
            return None
        if answer is not None and (answer is not Answer.go or (self._after and self._refused)):
            self._hand.correct()
        return answer
