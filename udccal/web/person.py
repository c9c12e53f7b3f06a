"""A person before a page: what is told is shown to every window, and one window answers."""

from __future__ import annotations

import enum
import math
import threading
import time
from dataclasses import dataclass, replace
from typing import final

from udccal.cameras.protocol import Frame
from udccal.guide.events import Answer, Event, Outline
from udccal.web.lead import Lead
from udccal.web.picture import Sampling, make_picture
from udccal.web.shown import Question, Shown
from udccal.web.view import LiveView, View

# How often a waiting window looks for a newer picture: frames come without a signal, so that ``look`` costs nothing.
_TICK_S = 0.05
_LATELY_S = 2.0


class Reception(enum.StrEnum):
    """What became of an answer that a window gave."""

    taken = "taken"
    watches = "Another window leads this calibration; this one watches."
    late = "This answer is not offered any more."


@final
@dataclass(frozen=True)
class News:
    """What a window is sent: the state with its version, whether the window may answer, and a newer view if any."""

    version: int
    may_answer: bool
    shown: Shown
    view: View | None


@final
class WebPerson:
    """Implements ``udccal.guide.events.Person`` for the capture, and ``news`` and ``give`` for the windows' requests.

    Args:
        sampling: what the camera's numbers mean.
    """

    def __init__(self, sampling: Sampling) -> None:
        self._view = LiveView(lambda frame: make_picture(frame, sampling))
        self._lead = Lead()
        self._changed = threading.Condition()
        self._shown = Shown()
        self._version = 1
        self._questions = 0
        self._given: Answer | None = None
        self._asked_s = -math.inf

    @property
    def watched(self) -> bool:
        """Whether a window asked for news lately."""
        return time.monotonic() - self._asked_s < _LATELY_S

    def tell(self, event: Event) -> None:
        """Show an event."""
        with self._changed:
            self._show(self._shown.after(event))

    def look(self, frame: Frame, outlines: tuple[Outline, ...]) -> None:
        """Take the newest frame."""
        self._view.look(frame, outlines)

    def answer(self, offered: tuple[Answer, ...], wait_s: float) -> Answer | None:
        """Wait for one of the answers that are offered; a question stays open between calls that offer the same."""
        with self._changed:
            question = self._shown.question
            if question is None or question.offered != offered:
                self._questions += 1
                self._show(replace(self._shown, question=Question(self._questions, offered)))
            self._changed.wait_for(lambda: self._given is not None, min(wait_s, threading.TIMEOUT_MAX))
            given, self._given = self._given, None
            if given is not None:
                self._show(self._shown.answered())
            return given

    def news(self, window: str, version: int, view: int, wait_s: float) -> News:
        """Wait until there is something that a window does not know, or ``wait_s`` are over.

        Args:
            window: its name.
            version, view: numbers of the state and of the view that it has; 0 for none.
            wait_s: longest wait.
        """
        end_s = time.monotonic() + wait_s
        while True:
            newer = self._view.newer(view)
            with self._changed:
                self._lead.heard(window)
                self._asked_s = time.monotonic()
                if newer is not None or self._version != version or time.monotonic() >= end_s:
                    return News(self._version, self._lead.allows(window), self._shown, newer)
                self._changed.wait_for(lambda: self._version != version, _TICK_S)

    def give(self, window: str, question: int, answer: Answer) -> Reception:
        """Take a window's answer to a question, if that window may answer and the question is open and offers it."""
        with self._changed:
            asked = self._shown.question
            if not self._lead.allows(window):
                return Reception.watches
            if asked is None or asked.number != question or answer not in asked.offered or self._given is not None:
                return Reception.late
            self._lead.take(window)
            self._given = answer
            self._changed.notify_all()
            return Reception.taken

    def _show(self, shown: Shown) -> None:
        """Show another state; call with the lock. An answer to a question that closed is dropped."""
        if shown.question != self._shown.question:
            self._given = None
        self._shown = shown
        self._version += 1
        self._changed.notify_all()
