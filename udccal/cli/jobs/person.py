"""A person at the rig: told what to set up, asked when it stands, and asked whether to try again."""

from __future__ import annotations

from typing import final

from udccal.arrangements import Arrangement, Occasion
from udccal.cli.output import Output

_GIVE_UP = "q"


@final
class PersonStage:
    """Implements ``udccal.arrangements.Stage``: says each instruction once and waits until the person has done it."""

    def __init__(self, output: Output) -> None:
        self._output = output
        self._standing: str | None = None

    def arrange(self, arrangement: Arrangement, occasion: Occasion) -> None:
        """Tell what to do, and wait; what stands already from the step before is not asked for again."""
        if occasion.instruction == self._standing:
            return
        self._output.ask(f"\n{occasion.step_id}: {occasion.instruction}\nPress Enter when it is so.")
        self._standing = occasion.instruction

    def try_again(self, sentence: str) -> bool:
        """Say what was wrong and ask whether to repeat the step; False to stop for now."""
        self._standing = None
        answer = self._output.ask(f"\n{sentence}\nPress Enter to repeat the step, or {_GIVE_UP} and Enter to stop.")
        return answer.strip().lower() != _GIVE_UP
