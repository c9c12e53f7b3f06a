"""What a term's predictor is: the sigma of one quantity, in which people speak of the term, and its floor."""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType
from typing import Final, Protocol, final, runtime_checkable

from udccal.rig import Captures
from udccal.sessions.schema import TermName


@final
@dataclass(frozen=True)
class Quantity:
    """What the sigma of a term is of, and its unit."""

    unit: str
    meaning: str


QUANTITIES: Final = MappingProxyType[TermName, Quantity](
    {
        "noise": Quantity("%", "conversion gain K, relative"),
        "geometry": Quantity("px", "where a ray lands, root mean square over the sensor"),
        "wire": Quantity("%", "wire map, root mean square over the sensor"),
        "psf": Quantity("%", "kernel, relative L2"),
        "backscatter": Quantity("%", "predicted light, root mean square, of its peak"),
    }
)


@final
@dataclass(frozen=True)
class Floor:
    """The sigma that is left however much is captured, in the quantity's unit, and what would lower it."""

    sigma: float
    lowered_by: str


@runtime_checkable
class Predictor(Protocol):
    """Predicts one term of one rig; remembers what does not change with the captures."""

    def sigma(self, captures: Captures) -> float:
        """Of the term's quantity; infinite where the captures do not suffice for a fit."""

    def floor(self) -> Floor:
        """In the limit of endless captures."""

    def used(self, captures: Captures) -> float:
        """Part of the captures' information on the quantity that the fit, at its default effort, spends; 1 is all."""
