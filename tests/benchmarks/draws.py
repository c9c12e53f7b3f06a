"""Simulated rigs that are drawn independently of each other, for the accuracy table."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from pathlib import Path

from udccal.rig import RigDescription, load_rig
from udccal.simulation.truth import RigTruth, draw_truth

_RIGS = Path(__file__).resolve().parent / "rigs"
FULL, REDUCED = ("lg55-aca2040", "mk31-imx1600"), ("lg55-reduced", "mk31-reduced")
# Of the draws of a reduced rig, every fourth has its nominal values at the ends of their tolerances.
_AT_ENDS = 4


@dataclass(frozen=True)
class Draw:
    """One specimen: the ``number``-th of a rig that ships, or of those beside this file."""

    rig: str
    number: int

    @classmethod
    def named(cls, name: str) -> Draw:
        """Of ``str(draw)``.

        Raises:
            ValueError: when it is none.
        """
        rig, _, number = name.rpartition("-")
        if rig not in FULL + REDUCED or not number.isdigit():
            raise ValueError(f"Expected a rig and a number, such as {FULL[0]}-0, found '{name}'. Name one of the rigs.")
        return cls(rig, int(number))

    def __str__(self) -> str:
        return f"{self.rig}-{self.number}"

    @property
    def seed(self) -> int:
        """Of truth, noise and patterns. Rigs with one seed would have the same draws, so every specimen has its own."""
        return zlib.crc32(str(self).encode())

    @property
    def at_ends(self) -> bool:
        """Whether every nominal value is off by its whole tolerance."""
        return self.rig in REDUCED and self.number % _AT_ENDS == _AT_ENDS - 1

    @property
    def description(self) -> RigDescription:
        """From which its fits start."""
        own = _RIGS / self.rig
        return load_rig(own if own.is_dir() else self.rig)

    @property
    def truth(self) -> RigTruth:
        """The rig as it really is."""
        return draw_truth(self.description, self.seed, self.at_ends)


def draws(seeds: int, rigs: tuple[str, ...] = FULL + REDUCED) -> list[Draw]:
    """One of each full-size rig, and ``seeds`` of each reduced one."""
    return [Draw(rig, number) for rig in rigs for number in range(1 if rig in FULL else seeds)]
