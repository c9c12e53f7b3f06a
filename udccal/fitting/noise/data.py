"""What the noise fit starts from: frames in the dark and under even light, from a session or as arrays.

Frames may be arrays, memory maps, or functions that load one; each is loaded when its turn comes and dropped again, so
that memory does not grow with their number.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import final

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8, UInt16

from udccal.errors import FitError
from udccal.fitting.noise.moments import Averaged, Codes, Moments, reduce_frames
from udccal.fitting.noise.rules import NoiseRules
from udccal.sessions.store import Session

# A level may hold frames of unlike size, until they are loaded: the sizes are not compared here.
Frame = UInt16[np.ndarray, "_rows _columns"] | UInt8[np.ndarray, "_rows _columns"] | Callable[[], np.ndarray]

_MOST_SIDE, _LEAST_SIDE = 65536, 16
_MOST_FRAMES = 4096
_THREADS = 2
# Groups of codes of a histogram, and samples of a strip, which stays in the processor's cache.
_MOST_CODES, _STRIP = 160, 1 << 18


@final
@dataclass(frozen=True)
class ExposureLevel:
    """One exposure time: two dark frames, or two bright ones, or both.

    Attributes:
        exposure_s: exposure time.
        dark: pair of frames without light; empty where not taken.
        bright: pair of frames under even light; empty where not taken.
        photons: mean number of photons per pixel, where known; exposure times stand for it where no level has it.
    """

    exposure_s: float
    dark: tuple[Frame, ...] = ()
    bright: tuple[Frame, ...] = ()
    photons: float | None = None


@final
@dataclass(frozen=True)
class SpatialStack:
    """Many frames alike, or their average, for the fixed pattern: dark and bright (EMVA 1288, clause 8)."""

    exposure_s: float
    dark: Sequence[Frame] | Averaged
    bright: Sequence[Frame] | Averaged
    photons: float | None = None


@final
@dataclass(frozen=True)
class NoiseData:
    """Frames of one sensor.

    Attributes:
        levels: exposures; at least two with dark and three with bright pairs are needed.
        stack: for DSNU and PRNU; without it the pair nearest to half of saturation serves.
        bayer: the sensor carries a mosaic of 2 x 2 colours.
        top_code: the converter's largest code; the smallest 2^n - 1 that holds all codes where not given.
    """

    levels: Sequence[ExposureLevel]
    stack: SpatialStack | None = None
    bayer: bool = False
    top_code: int | None = None


@final
@dataclass(frozen=True)
class DarkPair:
    """A pair of dark frames reduced to the joint histogram of the two codes of each pixel.

    The outermost edges are infinite where the codes stop there (at 0, or at the converter's end).
    """

    exposure_s: float
    edges_DN: Float[np.ndarray, " codes_plus_1"]
    counts: Int[np.ndarray, "codes codes"]
    outside: int
    rows: int

    @property
    def step_DN(self) -> float:
        """The smallest width of a group of codes."""
        return float(np.min(np.diff(self.edges_DN)))

    @property
    def centres_DN(self) -> Float[np.ndarray, " codes"]:
        """Middle of each group of codes; of a cut-off end, where its neighbours would put it."""
        edges = self.edges_DN.copy()
        step = self.step_DN if np.isfinite(self.step_DN) else 1.0
        edges[0] = edges[0] if np.isfinite(edges[0]) else edges[1] - step
        edges[-1] = edges[-1] if np.isfinite(edges[-1]) else edges[-2] + step
        return np.asarray(0.5 * (edges[1:] + edges[:-1]))


@final
@dataclass(frozen=True)
class NoiseMoments:
    """The frames, reduced.

    Attributes:
        darks: joint histograms of dark pairs; and ``dark_moments`` of the same pairs.
        flats: moments of bright pairs.
        dark_stack, flat_stack: averages of about the same exposure.
        q_DN: the converter's step.
        top_DN: its largest code.
        period: colour sites repeat after so many samples (1: monochrome).
    """

    darks: tuple[DarkPair, ...]
    dark_moments: tuple[Moments, ...]
    flats: tuple[Moments, ...]
    dark_stack: Averaged
    flat_stack: Averaged
    q_DN: int
    top_DN: float
    period: int = 2


def read_noise(session: Session) -> NoiseData:
    """The steps ``noise/*`` of a session; frames are read when the fit comes to them.

    Args:
        session: holds ``noise/dark_{i}`` and ``noise/flat_{i}`` (two frames each), ``noise/dark_stack`` and
            ``noise/flat_stack`` (averages).

    Raises:
        SessionError: when the file of an average is missing or damaged; of a frame, when it is read.
    """
    levels, stacks = [], {}
    for step in session.steps("noise"):
        exposure_s = step.captures[0].exposure_s
        if step.id.endswith("_stack"):
            average = session.average(step.captures[0])
            stacks[step.id] = Averaged(exposure_s, average.mean, average.frames)
            continue
        pair = tuple(partial(session.frame, capture) for capture in step.captures[:2])
        lit = step.id.startswith("noise/flat_")
        levels.append(ExposureLevel(exposure_s, bright=pair) if lit else ExposureLevel(exposure_s, dark=pair))
    dark, flat = stacks.get("noise/dark_stack"), stacks.get("noise/flat_stack")
    stack = SpatialStack(flat.exposure_s, dark, flat) if dark is not None and flat is not None else None
    return NoiseData(tuple(levels), stack, bayer=True, top_code=int(session.rig.saturation_DN))


def reduced(data: NoiseData, rules: NoiseRules) -> NoiseMoments | None:
    """All frames as the moments and histograms that the fit needs; None without a dark and a bright pair.

    Raises:
        FitError: when a frame is not a picture of codes like the others, or an exposure is no time.
    """
    _check(data)
    darks, brights = ([one for one in data.levels if getattr(one, kind)] for kind in ("dark", "bright"))
    if not darks or not brights:
        return None
    stack, period = data.stack, 2 if data.bayer else 1
    sample = _loaded(brights[len(brights) // 2].bright[0])
    q_DN = converter_step(sample)
    metered = all(level.photons is not None for level in brights) and (stack is None or stack.photons is not None)

    def moments(frames: Sequence[Frame] | Averaged, exposure_s: float, photons: float | None) -> Averaged:
        if isinstance(frames, Averaged):
            return frames
        loaders = [partial(_loaded, frame, sample.shape) for frame in frames]
        return reduce_frames(loaders, exposure_s, photons if metered else None, period, rules)

    def pair(frames: Sequence[Frame], exposure_s: float, photons: float | None) -> Moments:
        found = moments(frames, exposure_s, photons).temporal
        assert found is not None, "frames that were seen have moments"
        return found

    def dark(level: ExposureLevel) -> tuple[DarkPair, Moments]:
        frames = tuple(_loaded(frame, sample.shape) for frame in level.dark)
        histogram = dark_pair(frames[0], frames[1], level.exposure_s, q_DN, top)
        return histogram, pair(frames, level.exposure_s, None)

    with ThreadPoolExecutor(_THREADS) as pool:
        # The stacks are the longest tasks: they go first.
        tasks = [] if stack is None else [
            pool.submit(moments, frames, stack.exposure_s, stack.photons) for frames in (stack.dark, stack.bright)
        ]  # fmt: skip
        flats = tuple(pool.map(lambda level: pair(level.bright, level.exposure_s, level.photons), brights))
        top = _top_code(flats, data.top_code, q_DN)
        found = tuple(pool.map(dark, darks))
        if stack is None:
            ceiling = min(max(float(np.mean(flat.mean_DN)) for flat in flats), float(top))
            middle = brights[int(np.argmin([abs(float(np.mean(flat.mean_DN)) - 0.5 * ceiling) for flat in flats]))]
            near = min(darks, key=lambda level: abs(level.exposure_s - middle.exposure_s))
            tasks = [
                pool.submit(moments, frames, level.exposure_s, None)
                for frames, level in ((near.dark, near), (middle.bright, middle))
            ]
        stacks = [task.result() for task in tasks]
    if stack is None:
        # The same pairs must not tell their variance twice.
        stacks = [replace(one, temporal=None) for one in stacks]
    histograms, dark_moments = tuple(one for one, _ in found), tuple(one for _, one in found)
    return NoiseMoments(histograms, dark_moments, flats, stacks[0], stacks[1], q_DN, float(top), period)


def dark_pair(first: Codes, second: Codes, exposure_s: float, q_DN: int = 1, top_code: int = 65535) -> DarkPair:
    """Joint histogram over a window of codes around the median; codes beyond it are counted as outside."""
    low, middle, high = np.percentile(first[:: max(1, first.size // 65536)], [2.0, 50.0, 98.0])
    # 98th minus 2nd percentile is 4.1 sigma; 1.9 times that each side is about 7.8 sigma.
    half = int(np.ceil(1.9 * (high - low) / q_DN)) + 4
    group = max(1, int(np.ceil((2 * half + 1) / _MOST_CODES)))
    start = max(round(middle / q_DN) - half, 0)
    codes = min((round(middle / q_DN) + half - start) // group, (top_code // q_DN - start) // group) + 1
    # One more group takes all that lies outside the window, codes below it included: they wrap around.
    side = codes + 1
    joint = np.zeros(side * side, np.int64)

    def groups(frame: Codes) -> Codes:
        shifted = (frame // np.uint16(q_DN) if q_DN > 1 else frame) - np.uint16(start)
        if group > 1:
            shifted = np.where(shifted < group * codes, shifted // np.uint16(group), np.uint16(codes))
        return np.minimum(shifted, np.uint16(codes))

    height = max(_STRIP // first.shape[1], 1)
    for top in range(0, first.shape[0], height):
        index = groups(first[top : top + height]) * np.uint16(side) + groups(second[top : top + height])
        joint += cv2.calcHist([index], [0], None, [joint.size], [0, joint.size]).ravel().astype(np.int64)
    counts = joint.reshape(side, side)[:codes, :codes]
    edges = (start + group * np.arange(codes + 1) - 0.5) * q_DN
    edges[0] = -np.inf if start == 0 else edges[0]
    edges[-1] = np.inf if edges[-1] >= top_code else edges[-1]
    return DarkPair(exposure_s, edges.astype(np.float64), counts, int(first.size - counts.sum()), first.shape[0])


def converter_step(frame: Codes) -> int:
    """Smallest step between codes: greater than 1 where a converter's bits are shifted up in 16-bit samples."""
    codes = np.flatnonzero(np.bincount(frame.ravel(), minlength=2))
    return int(np.gcd.reduce(np.diff(codes))) if codes.size > 2 else 1


def _loaded(frame: Frame, shape: tuple[int, ...] | None = None) -> Codes:
    """A frame; one that is none, or is not of the shape of the others, is refused."""
    array = frame() if callable(frame) else frame
    if not isinstance(array, np.ndarray) or array.dtype not in (np.uint8, np.uint16) or array.ndim != 2:
        found = f"{array.dtype} of shape {array.shape}" if isinstance(array, np.ndarray) else type(array).__name__
        raise FitError(f"Expected a frame as uint8 or uint16 array of rows x columns, found {found}. Pass raw codes.")
    if min(array.shape) < _LEAST_SIDE or max(array.shape) > _MOST_SIDE:
        raise FitError(f"Expected frames of {_LEAST_SIDE} to {_MOST_SIDE} samples a side, found {array.shape}.")
    if shape is not None and array.shape != shape:
        raise FitError(f"Expected frames of {shape} samples, found {array.shape}. Sort the frames by sensor.")
    return array if array.dtype == np.uint16 else array.astype(np.uint16)


def _check(data: NoiseData) -> None:
    stacks = [] if data.stack is None else [s for s in (data.stack.dark, data.stack.bright) if isinstance(s, Sequence)]
    if max([len(data.levels), *map(len, stacks)]) > _MOST_FRAMES:
        raise FitError(f"Expected at most {_MOST_FRAMES} levels and frames of a stack, found more. Average some first.")
    if stacks and min(map(len, stacks)) < 2:
        raise FitError("Expected at least two dark and two bright frames in the stack, found fewer. Leave it out.")
    for index, level in enumerate(data.levels):
        if not (np.isfinite(level.exposure_s) and level.exposure_s >= 0):
            raise FitError(f"Expected level {index} to have an exposure in seconds, found {level.exposure_s}.")
        if level.photons is not None and not (np.isfinite(level.photons) and level.photons >= 0):
            raise FitError(f"Expected level {index} to have a number of photons, found {level.photons}.")
        for name, frames in (("dark", level.dark), ("bright", level.bright)):
            if len(frames) not in (0, 2):
                raise FitError(f"Expected two {name} frames in level {index} or none, found {len(frames)}.")


def _top_code(flats: tuple[Moments, ...], declared: int | None, q_DN: int) -> int:
    peak = max(flat.peak_DN for flat in flats)
    if declared is None:
        return int(2 ** max(int(np.ceil(np.log2(peak + q_DN))), 8) - q_DN)
    if peak > declared:
        raise FitError(f"Expected codes up to {declared}, found {peak}. Give the converter's largest code as top_code.")
    return declared
