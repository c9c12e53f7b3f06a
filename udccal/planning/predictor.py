"""The interface of a term's predictor: the sigma of one quantity, which stands for the term, and its floor."""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType
from typing import Final, Protocol, final, runtime_checkable

from udccal.rig import Captures
from udccal.sessions.schema import TermName


@final
@dataclass(frozen=True)
class Quantity:
    """The quantity whose sigma stands for a term: its unit and its meaning."""

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
    """The sigma that no number of captures lowers, in the quantity's unit, and a change that would lower it."""

    sigma: float
    lowered_by: str


@runtime_checkable
class Predictor(Protocol):
    """Predicts one term of one rig; it keeps the results that do not depend on the captures."""

    def sigma(self, captures: Captures) -> float:
        """Sigma of the term's quantity; infinite where the captures do not suffice for a fit."""

    def floor(self) -> Floor:
        """Sigma in the limit of endless captures."""

    def used(self, captures: Captures) -> float:
        """Part of the captures' information on the quantity that the fit, at its default effort, uses; 1 is all."""
