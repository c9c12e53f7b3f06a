"""What every term's prediction gives: the sigma of planned captures, and the one that no captures get below."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, final, runtime_checkable

from udccal.rig import Captures


@final
@dataclass(frozen=True)
class Floor:
    """The sigma that is left however much is captured, in the target's unit, and what would lower it."""

    sigma: float
    lowered_by: str


@runtime_checkable
class Predictor(Protocol):
    """Predicts one term of one rig; remembers what does not change with the captures."""

    def sigma(self, captures: Captures) -> float:
        """In the unit of the term's target; infinite where the captures do not suffice for a fit."""
        ...

    def floor(self) -> Floor:
        """In the limit of endless captures."""
        ...

    def used(self, captures: Captures) -> float:
        """Share of the captures' information on the target that the fit, at its default effort, spends; 1 is all."""
        ...
