"""A person at a terminal: what is told is printed, and a word and Enter is an answer."""

from __future__ import annotations

import math
import queue
import sys
import threading
from typing import Final, final

from udccal.cameras.protocol import Frame
from udccal.cli.output import Output
from udccal.errors import UdccalError
from udccal.guide.events import (
    Answer,
    DoneEvent,
    Event,
    Outline,
    ProgressEvent,
    Reading,
    ReadingsEvent,
    RequestEvent,
    StepEvent,
    VerdictEvent,
)

_MEANING: Final = {
    Answer.go: "Enter",
    Answer.again: "again",
    Answer.skip: "skip",
    Answer.back: "back",
    Answer.quit: "quit",
    Answer.wrong: "wrong",
}
_CLOSED: Final = None


@final
class TerminalPerson:
    """Implements ``udccal.guide.events.Person``.

    Readings are printed when what they say changes, not with each frame. Standard input is read in a thread of its own,
    line by line, so that frames go on while nobody types. An Enter that was typed before a question does not answer it;
    a word does.
    """

    def __init__(self, output: Output) -> None:
        self._output = output
        self._lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._closed = False
        self._said = ""
        self._asked: tuple[Answer, ...] = ()
        threading.Thread(target=self._read, daemon=True).start()

    def tell(self, event: Event) -> None:
        """Print an event."""
        if isinstance(event, StepEvent | VerdictEvent | RequestEvent) and sys.stdin.isatty():
            self._forget_enters()
        match event:
            case StepEvent():
                self._said, self._asked = "", ()
                self._output.say(
                    f"\nStep {event.number} of {event.of}, {_left(event.minutes_left)}: {event.title}\n"
                    f"  {event.why}\n  {event.instruction}"
                )
            case ReadingsEvent():
                self._show(event.readings, event.sentence)
            case ProgressEvent():
                self._output.say(f"  {event.frames} of {event.of} frames")
            case VerdictEvent():
                self._asked = ()
                self._output.say(f"  {'✓' if event.ok else '✗'} {event.sentence}")
            case RequestEvent():
                self._asked = ()
                self._output.say(f"  {event.sentence}")
            case DoneEvent():
                self._output.say(event.sentence)

    def look(self, frame: Frame, outlines: tuple[Outline, ...]) -> None:
        """A terminal shows no picture."""

    def answer(self, offered: tuple[Answer, ...], wait_s: float) -> Answer | None:
        """Return the answer of the next line; say so where a line is none.

        Raises:
            UdccalError: when standard input is closed, and an answer is waited for.
        """
        if offered != self._asked:
            self._asked = offered
            self._output.say(f"  [{' · '.join(_MEANING[answer] for answer in offered)}]")
        try:
            line = self._lines.get(timeout=wait_s) if wait_s and not self._closed else self._lines.get_nowait()
        except queue.Empty:
            self._check_open(wait_s)
            return None
        if line is _CLOSED:
            self._closed = True
            self._check_open(wait_s)
            return None
        word = line.strip().lower() or _MEANING[Answer.go].lower()
        for answer in offered:
            if word in (answer.value, _MEANING[answer].lower()):
                return answer
        said = "Enter alone" if word == "enter" else f"'{word[:40]}'"
        self._output.say(f"  {said} is none of the answers: {', '.join(_MEANING[answer] for answer in offered)}.")
        return None

    def _forget_enters(self) -> None:
        """Take back the Enters that nobody has asked for: an impatient one would accept what comes next unread."""
        words = []
        while not self._lines.empty():
            line = self._lines.get_nowait()
            words += [line] if line is _CLOSED or line.strip() else []
        for line in words:
            self._lines.put(line)

    def _check_open(self, wait_s: float) -> None:
        if self._closed and wait_s:
            raise UdccalError(
                "Expected a person to answer, found that standard input is closed. Run the command in a terminal; it "
                "continues where it stopped."
            )

    def _show(self, readings: tuple[Reading, ...], sentence: str) -> None:
        """Print a look when another sentence has become true, or other readings are right."""
        said = sentence + "".join("✓" if reading.ok else "✗" for reading in readings)
        if said != self._said:
            self._said = said
            self._output.say(f"  {', '.join(_shown(reading) for reading in readings)}")
            if sentence:
                self._output.say(f"  {sentence}")

    def _read(self) -> None:
        for line in sys.stdin:
            self._lines.put(line)
        self._lines.put(_CLOSED)


def _shown(reading: Reading) -> str:
    known = f"{reading.value:.3g} {reading.unit}".rstrip() if math.isfinite(reading.value) else "–"
    return f"{reading.name} {known}" + (" ✓" if reading.ok else " ✗")


def _left(minutes: float) -> str:
    return f"{minutes:.0f} minutes left" if minutes >= 1.5 else "about a minute left"
