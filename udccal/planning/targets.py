"""What a plan is to reach: one standard deviation per term, in the unit in which people speak of that term."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final, final, get_args

from udccal.errors import UdccalError
from udccal.sessions.schema import TermName


@final
@dataclass(frozen=True)
class Quantity:
    """What the sigma of a term is said of, and its unit."""

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
_FORM: Final = re.compile(r"(?P<term>[^=\s]+)=(?P<value>[-+.0-9]*(?:[eE][-+]?[0-9]+)?)(?P<unit>%|[a-zA-Z]*)")
_EXAMPLE: Final = "Write, for example, wire=0.05% or geometry=0.1px."


@final
@dataclass(frozen=True)
class Target:
    """One standard deviation that a term is to reach, in the unit of ``QUANTITIES``."""

    term: TermName
    sigma: float

    @property
    def text(self) -> str:
        """As it is written on the command line."""
        return f"{self.term}={self.sigma:g}{QUANTITIES[self.term].unit}"


def parse_targets(words: Sequence[str]) -> tuple[Target, ...]:
    """Targets such as ``wire=0.05%``, in the order of the terms.

    Raises:
        UdccalError: when a word is no target, names no term or another unit, or the terms repeat.
    """
    targets = [parse_target(word) for word in words]
    terms = [target.term for target in targets]
    for term in terms:
        if terms.count(term) > 1:
            raise UdccalError(f"Expected one target for {term}, found {terms.count(term)}. Keep one of them.")
    order = get_args(TermName)
    return tuple(sorted(targets, key=lambda target: order.index(target.term)))


def parse_target(word: str) -> Target:
    """One target; errors as ``parse_targets``."""
    match = _FORM.fullmatch(word.strip())
    if match is None:
        raise UdccalError(f"Expected a target such as wire=0.05%, found '{word}'. {_EXAMPLE}")
    term = _term(match["term"])
    sigma = _positive(match["value"], word)
    unit = QUANTITIES[term].unit
    if match["unit"] != unit:
        found = f"'{match['unit']}'" if match["unit"] else "none"
        raise UdccalError(f"Expected the target of {term} in {unit}, found the unit {found} in '{word}'. {_EXAMPLE}")
    return Target(term, sigma)


def _term(name: str) -> TermName:
    for term in get_args(TermName):
        if name == term:
            found: TermName = term
            return found
    raise UdccalError(f"Expected a target for {', '.join(get_args(TermName))}, found one for '{name}'. {_EXAMPLE}")


def _positive(text: str, word: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0):
        raise UdccalError(f"Expected a target above zero, found '{word}'. {_EXAMPLE}")
    return value
