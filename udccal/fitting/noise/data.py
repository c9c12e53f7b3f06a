"""Frames in the dark and under even light, from a session or as arrays; and the rules of the noise fit.

The fit loads one frame after another and drops it again, so that memory does not grow with their number.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import final

import numpy as np
from jaxtyping import Float32, UInt8, UInt16

from udccal.arguments import check_count, check_number, check_optional, check_unmasked, found_instead
from udccal.errors import FitError, UdccalError
from udccal.sessions.store import Session

Codes = UInt16[np.ndarray, "rows columns"]
# An array, memory map, or function that loads one. Their sizes may differ until they are loaded: types compare none.
Frame = UInt16[np.ndarray, "_rows _columns"] | UInt8[np.ndarray, "_rows _columns"] | Callable[[], np.ndarray]

_LEAST_SIDE, _MOST_SIDE, _MOST_FRAMES, _LARGEST_CODE = 16, 65536, 4096, 65535


@final
@dataclass(frozen=True)
class NoiseRules:
    """The documented constants of the noise fit.

    Attributes:
        hit_sigma: codes of one pixel that differ by more are a hit or a blinking pixel.
        outlier_sigma: bins and levels farther off the curve, in robust sigma, are left out.
        defect_sigma: pixels farther off the rest, in robust sigma, are defects; of millions, 5 would reject good ones.
        background: fraction of dark samples that may have any code; it limits the weight of an outlier.
        shape_sigma: prior sigma of the read noise's shape; it matters only where rounding hides the shape.
        white: rounding counts as white, and no code as cut off, where the mean code follows black to this fraction.
        smeared: rounding does not show where its first harmonic is down by this, as a natural logarithm.
        fit_up_to, narrow_up_to: fraction of saturation that the fit reaches; the second (EMVA 1288) where it
            describes the data far better.
        most_bent: fraction of the signal missing at full scale above which a quadratic does not describe the response.
        levels: fewest exposures of a photon transfer curve.
        gain_sigma: least gain in units of its sigma; quotients by a less certain gain have no symmetric error.
        foreign_sigma: read noise whose measured variance is farther from the fitted distribution's, in sigma, has
            none of the family's distributions.
        most_hits: fraction of pixels that radiation hits at most in a dark pair.
        contradictory: chance below which the noise of dark frames contradicts their exposure times.
        apart: factor by which dark signals may differ from their exposures' ratio: a sensor that warms by 10 degrees.
        stuck: part of the other dark pairs' temporal variance below which a pair is stuck at a code.
        quiet: part of the noise that its number of frames leaves below which an average has more frames.
        most_hot: fraction of dark samples that are hot pixels above which a note tells of them.
        most_shared: change of the gain by noise that neighbours share above which the fit is poor.
        worst_chi2: reduced chi-squared above which the sensor is not what the model says.
    """

    hit_sigma: float = 8.0
    outlier_sigma: float = 5.0
    defect_sigma: float = 6.0
    background: float = 1e-5
    shape_sigma: float = 0.3
    white: float = 0.005
    smeared: float = 6.0
    fit_up_to: float = 0.9
    narrow_up_to: float = 0.7
    most_bent: float = 0.24
    levels: int = 3
    gain_sigma: float = 10.0
    foreign_sigma: float = 3.0
    most_hits: float = 1e-4
    contradictory: float = 1e-9
    apart: float = 3.0
    stuck: float = 0.02
    quiet: float = 0.5
    most_hot: float = 1e-3
    most_shared: float = 0.05
    worst_chi2: float = 6.0


@final
@dataclass(frozen=True)
class Averaged:
    """Mean of frames of one scene and exposure."""

    exposure_s: float
    mean_DN: Float32[np.ndarray, "rows columns"]
    frames: int

    def check(self, shape: tuple[int, ...]) -> None:
        """A FitError where it is not the mean of a number of frames of ``shape``."""
        mean = self.mean_DN
        check_unmasked(mean, "an average of the stack", FitError)
        if not isinstance(mean, np.ndarray) or mean.dtype.kind != "f" or mean.shape != shape:
            found = f"float array of {shape} samples, as the frames of the pairs, found {found_instead(mean)}"
            raise FitError(f"Expected an average of the stack as {found}. Give the mean as it is, without rounding.")
        if bad := int(np.count_nonzero(~np.isfinite(mean))):
            found = f"found {bad} samples that are no number. Leave it out."
            raise FitError(f"Expected codes in an average of the stack, {found}")
        check_count(self.frames, "the frames of an average in the stack", 1, 2**31, FitError)


@final
@dataclass(frozen=True)
class ExposureLevel:
    """One exposure time: two dark frames, or two bright ones, or both.

    Attributes:
        exposure_s: exposure time.
        dark, bright: pairs of frames without light and under even light, or arrays of them; empty where not taken.
        photons: mean number per pixel, where known; exposure times take its place where a level has none.
    """

    exposure_s: float
    dark: Sequence[Frame] | np.ndarray = ()
    bright: Sequence[Frame] | np.ndarray = ()
    photons: float | None = None


@final
@dataclass(frozen=True)
class SpatialStack:
    """Many dark and many bright frames, or their averages, for the fixed pattern (EMVA 1288, clause 8)."""

    exposure_s: float
    dark: Sequence[Frame] | np.ndarray | Averaged
    bright: Sequence[Frame] | np.ndarray | Averaged
    photons: float | None = None


@final
@dataclass(frozen=True)
class NoiseData:
    """Frames of one sensor.

    Attributes:
        levels: exposures; at least two with dark and three with bright pairs are needed.
        stack: for DSNU and PRNU; without it the pair nearest to half of saturation serves.
        bayer: whether the sensor has a mosaic of 2 x 2 colours.
        top_code: the converter's largest code; where not given, the smallest 2^n - 1 not below any code.
    """

    levels: Sequence[ExposureLevel]
    stack: SpatialStack | None = None
    bayer: bool = False
    top_code: int | None = None

    def check(self) -> None:
        """Check kinds, numbers of frames, exposures and photons; a FitError names the level or stack that is wrong."""
        if not isinstance(self.levels, Sequence | np.ndarray):
            raise FitError(f"Expected a sequence of exposure levels, found {found_instead(self.levels)}. Give a list.")
        if self.top_code is not None:
            check_count(self.top_code, "top_code", 1, _LARGEST_CODE, FitError)
        if len(self.levels) > _MOST_FRAMES:
            raise FitError(f"Expected at most {_MOST_FRAMES} levels, found {len(self.levels)}. Leave some out.")
        for index, level in enumerate(self.levels):
            if not isinstance(level, ExposureLevel):
                found = f"found {found_instead(level)}. Give exposure and frames in one"
                raise FitError(f"Expected every level as an ExposureLevel, {found}.")
            _check_exposure(f"level {index}", level.exposure_s, level.photons)
            for name in ("dark", "bright"):
                if (found := _count(f"the {name} frames of level {index}", getattr(level, name))) not in (0, 2):
                    raise FitError(f"Expected two {name} frames in level {index} or none, found {found}.")
        check_optional(self.stack, SpatialStack, FitError)
        if self.stack is None:
            return
        _check_exposure("the stack", self.stack.exposure_s, self.stack.photons)
        for frames in (self.stack.dark, self.stack.bright):
            if isinstance(frames, Averaged):
                _check_exposure("an average of the stack", frames.exposure_s)
            elif not 2 <= (found := _count("the stack's frames", frames)) <= _MOST_FRAMES:
                expected = f"Expected 2 to {_MOST_FRAMES} dark and as many bright frames in the stack"
                raise FitError(f"{expected}, found {found}. Average some first, or leave the stack out.")


def _check_exposure(where: str, exposure_s: object, photons: object = None) -> None:
    light = 0.0 if photons is None else photons
    for name, value in (("an exposure in seconds", exposure_s), ("a number of photons", light)):
        check_number(value, f"{where} to have {name}", (0.0, 1e12), "Give a number of 0 or more.", FitError)


def _count(what: str, frames: object) -> int:
    """How many frames a sequence holds; a FitError where it is none."""
    if not isinstance(frames, Sequence | np.ndarray):
        found = f"found {found_instead(frames)}. Leave them out where none were taken"
        raise FitError(f"Expected {what} as a sequence, {found}.")
    return len(frames)


def loaded(frame: Frame, name: str, shape: tuple[int, ...] = ()) -> Codes:
    """A frame as codes; a FitError where it is not a picture of codes, or differs from ``shape`` (empty: any).

    ``name`` tells which frame it is, where a function that loads it fails.
    """
    try:
        array = frame() if callable(frame) else frame
    except UdccalError:
        raise
    except Exception as error:
        found = f"found {type(error).__name__}: {error}"
        raise FitError(f"Expected a function that loads {name}, {found}. Mend it, or give the array.") from error
    check_unmasked(array, name, FitError)
    kind = array.dtype.newbyteorder("=") if isinstance(array, np.ndarray) else None
    if kind not in (np.uint8, np.uint16) or array.ndim != 2:
        expected = "Expected a frame as uint8 or uint16 array of rows x columns"
        raise FitError(f"{expected}, found {found_instead(array)}. Pass raw codes.")
    if min(array.shape) < _LEAST_SIDE or max(array.shape) > _MOST_SIDE:
        raise FitError(f"Expected frames of {_LEAST_SIDE} to {_MOST_SIDE} samples a side, found {array.shape}.")
    if shape and array.shape != shape:
        raise FitError(f"Expected frames of {shape} samples, found {array.shape}. Sort the frames by sensor.")
    return array if array.dtype == np.uint16 else array.astype(np.uint16)


def read_noise(session: Session) -> NoiseData:
    """The steps ``noise/*`` of a session; frames are read when the fit uses them.

    Args:
        session: holds ``noise/dark_{i}`` and ``noise/flat_{i}`` (two frames each), ``noise/dark_stack`` and
            ``noise/flat_stack`` (averages).

    Raises:
        SessionError: when the file of an average is missing or damaged; of a frame, when it is read.
    """
    levels: list[ExposureLevel] = []
    averages: dict[str, Averaged] = {}
    for step in session.steps("noise"):
        exposure_s, name = step.captures[0].exposure_s, step.id.removeprefix("noise/")
        if name.endswith("_stack"):
            average = session.average(step.captures[0])
            averages[name] = Averaged(exposure_s, average.mean, average.frames)
            continue
        pair = tuple(partial(session.frame, capture) for capture in step.captures[:2])
        lit = name.startswith("flat_")
        levels.append(ExposureLevel(exposure_s, bright=pair) if lit else ExposureLevel(exposure_s, dark=pair))
    dark, flat = averages.get("dark_stack"), averages.get("flat_stack")
    stack = SpatialStack(flat.exposure_s, dark, flat) if dark is not None and flat is not None else None
    return NoiseData(tuple(levels), stack, bayer=True, top_code=int(session.rig.saturation_DN))


def dark_window(first: Codes, q_DN: int) -> tuple[int, int]:
    """Return the median of a dark frame, and how far usual codes reach about it, both in steps of the converter."""
    low, less, middle, more, high = np.percentile(first[:: max(1, first.size // 65536)], [2.0, 16.0, 50.0, 84.0, 98.0])
    # 98th minus 2nd percentile is 4.1 sigma; 1.9 times that each side is about 7.8 sigma.
    half = int(np.ceil(1.9 * (high - low) / q_DN)) + 4
    usual = int(np.ceil(3.9 * (more - less) / q_DN)) + 4
    # Unless hot pixels made it wide.
    return round(middle / q_DN), usual if half > max(2 * usual, 80) else half
