"""A person at the rig, who is told what to set up and asked whether to repeat a step."""

from __future__ import annotations

from typing import final

from udccal.arrangements import Arrangement, Occasion
from udccal.cli.output import Output

_GIVE_UP = "q"


@final
class PersonStage:
    """Implements ``udccal.arrangements.Stage``: prints each instruction once and waits until the person has done it."""

    def __init__(self, output: Output) -> None:
        self._output = output
        self._standing: str | None = None

    def arrange(self, arrangement: Arrangement, occasion: Occasion) -> None:
        """Print the instruction and wait; do not ask again for what the step before has set up."""
        if occasion.instruction == self._standing:
            return
        question = f"\n{occasion.step_id}: {occasion.instruction}\nPress Enter when it is done, or Ctrl-C to stop."
        self._output.choose(question, ("",))
        self._standing = occasion.instruction

    def try_again(self, sentence: str) -> bool:
        """Print what was wrong and ask whether to repeat the step; return False to stop for now."""
        self._standing = None
        question = f"\n{sentence}\nPress Enter to repeat the step, or {_GIVE_UP} and Enter to stop."
        return self._output.choose(question, ("", _GIVE_UP)) != _GIVE_UP
