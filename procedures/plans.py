"""Capture plans of a step, which the runner in ``procedures.base`` carries out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

# Usual number of metering frames; a step of known exposure takes one frame for its check.
_METERING_FRAMES = 4


@dataclass(frozen=True)
class Planned:
    """A step's exposure as expected before anything is captured.

    Attributes:
        exposure_s: exposure of the first frame.
        level: target between black (0) and saturation (1) in the step where the exposure is metered; None without one.
        test_frames: number of frames that find and check it.
    """

    exposure_s: float
    level: float | None
    test_frames: int


@dataclass(frozen=True)
class Metered:
    """The exposure that brings the signal to ``target`` of the range from black to saturation, found by test frames.

    ``signal`` ``even`` measures the 99.9th percentile (the brightest channel of an even field), ``spot`` the
    brightest sample of a small light.
    """

    target: float
    signal: Literal["even", "spot"] = "even"

    def planned(self, metered_s: float, earlier: Mapping[str, Planned]) -> Planned:
        """Return the exposure that metering is expected to find: ``metered_s``."""
        return Planned(metered_s, self.target, _METERING_FRAMES)


@dataclass(frozen=True)
class TimesThatOf:
    """``factor`` times the exposure of an earlier step's first capture, so that a resumed session has the same."""

    step_id: str
    factor: float = 1.0

    def planned(self, metered_s: float, earlier: Mapping[str, Planned]) -> Planned:
        """Return the expected exposure from the earlier step's; raise KeyError when there is no such step."""
        first = earlier[self.step_id]
        level = None if first.level is None else self.factor * first.level
        return Planned(self.factor * first.exposure_s, level, 1)


@dataclass(frozen=True)
class Fixed:
    """A fixed exposure."""

    exposure_s: float

    def planned(self, metered_s: float, earlier: Mapping[str, Planned]) -> Planned:
        """Return the fixed exposure."""
        return Planned(self.exposure_s, None, 1)


Exposure = Metered | TimesThatOf | Fixed


@dataclass(frozen=True)
class Stack:
    """One average of ``frames`` frames."""

    frames: int

    def exposures_s(self, first_s: float, longest_s: float) -> tuple[float, ...]:
        """Return the exposure of every frame."""
        return self.frames * (first_s,)


@dataclass(frozen=True)
class Singles:
    """``frames`` single frames at one exposure."""

    frames: int

    def exposures_s(self, first_s: float, longest_s: float) -> tuple[float, ...]:
        """Return the exposure of every frame."""
        return self.frames * (first_s,)


@dataclass(frozen=True)
class Bracket:
    """Up to ``frames`` single frames, each exposed ``factor`` times longer than the one before, up to the camera's
    longest exposure."""

    frames: int
    factor: float = 4.0

    def exposures_s(self, first_s: float, longest_s: float) -> tuple[float, ...]:
        """Return the exposure of every frame; the last is the camera's longest if the next step would exceed it."""
        exposures = [first_s]
        while len(exposures) < self.frames and exposures[-1] < longest_s:
            exposures.append(min(exposures[-1] * self.factor, longest_s))
        return tuple(exposures)


Plan = Stack | Singles | Bracket
