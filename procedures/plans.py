"""What a step captures, as small values that the runner in ``procedures.base`` carries out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

# What metering usually takes; a step whose exposure is known beforehand takes one frame to look at.
_METERING_FRAMES = 4


@dataclass(frozen=True)
class Planned:
    """What is known of a step's exposure before anything is captured.

    Attributes:
        exposure_s: of the first frame.
        level: of the range from black to saturation, where that is what the exposure aims at (of what stands before
            the camera in the step it was metered in); None where it is not.
        test_frames: how many are taken to find and to check it.
    """

    exposure_s: float
    level: float | None
    test_frames: int


@dataclass(frozen=True)
class Metered:
    """The exposure that brings the signal to ``target`` of the range from black to saturation, found by test frames.

    ``signal``: ``even`` looks at the 99.9th percentile (the brightest channel of an even field), ``spot`` at the
    brightest sample of a small light.
    """

    target: float
    signal: Literal["even", "spot"] = "even"

    def planned(self, metered_s: float, earlier: Mapping[str, Planned]) -> Planned:
        """As metering will find it; ``metered_s`` is what the light there is expected to ask for."""
        return Planned(metered_s, self.target, _METERING_FRAMES)


@dataclass(frozen=True)
class TimesThatOf:
    """``factor`` times the exposure of the first capture of an earlier step, so that resuming finds it again."""

    step_id: str
    factor: float = 1.0

    def planned(self, metered_s: float, earlier: Mapping[str, Planned]) -> Planned:
        """From that of the earlier step; raises KeyError when there is none of that name."""
        first = earlier[self.step_id]
        level = None if first.level is None else self.factor * first.level
        return Planned(self.factor * first.exposure_s, level, 1)


@dataclass(frozen=True)
class Fixed:
    """An exposure known beforehand."""

    exposure_s: float

    def planned(self, metered_s: float, earlier: Mapping[str, Planned]) -> Planned:
        """As it is."""
        return Planned(self.exposure_s, None, 1)


Exposure = Metered | TimesThatOf | Fixed


@dataclass(frozen=True)
class Stack:
    """One average of ``frames`` frames."""

    frames: int

    def exposures_s(self, first_s: float, longest_s: float) -> tuple[float, ...]:
        """Of every frame."""
        return self.frames * (first_s,)


@dataclass(frozen=True)
class Singles:
    """``frames`` single frames at one exposure."""

    frames: int

    def exposures_s(self, first_s: float, longest_s: float) -> tuple[float, ...]:
        """Of every frame."""
        return self.frames * (first_s,)


@dataclass(frozen=True)
class Bracket:
    """Up to ``frames`` single frames, each exposed ``factor`` times longer than the one before, up to the camera's
    longest exposure."""

    frames: int
    factor: float = 4.0

    def exposures_s(self, first_s: float, longest_s: float) -> tuple[float, ...]:
        """Of every frame; the last is the camera's longest if the next step would pass it."""
        exposures = [first_s]
        while len(exposures) < self.frames and exposures[-1] < longest_s:
            exposures.append(min(exposures[-1] * self.factor, longest_s))
        return tuple(exposures)


Plan = Stack | Singles | Bracket
