"""What a step captures, as small values that the runner in ``procedures.base`` carries out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Metered:
    """The exposure that brings the signal to ``target`` of the range from black to saturation, found by test frames.

    ``signal``: ``even`` looks at the 99.9th percentile (the brightest channel of an even field), ``spot`` at the
    brightest sample of a small light.
    """

    target: float
    signal: Literal["even", "spot"] = "even"


@dataclass(frozen=True)
class TimesThatOf:
    """``factor`` times the exposure of the first capture of an earlier step, so that resuming finds it again."""

    step_id: str
    factor: float = 1.0


@dataclass(frozen=True)
class Fixed:
    """An exposure known beforehand."""

    exposure_s: float


Exposure = Metered | TimesThatOf | Fixed


@dataclass(frozen=True)
class Stack:
    """One average of ``frames`` frames."""

    frames: int


@dataclass(frozen=True)
class Singles:
    """``frames`` single frames at one exposure."""

    frames: int


@dataclass(frozen=True)
class Bracket:
    """Up to ``frames`` single frames, each exposed ``factor`` times longer than the one before, up to the camera's
    longest exposure."""

    frames: int
    factor: float = 4.0


Plan = Stack | Singles | Bracket
