"""Cases of growing data: for each term and each growing quantity, its sizes and the work."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Case:
    """One growing quantity of one term; ``prepare(size)`` makes the data and returns the work on them."""

    term: str
    knob: str
    sizes: tuple[int, ...]
    prepare: Callable[[int], Callable[[], object]]
