"""The noise term from frames as plain arrays: pairs at several exposures, and stacks for the fixed pattern.

Frames may be arrays, memory maps, or functions that load one; each is loaded when its turn comes and dropped again, so
that memory does not grow with their number.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import UInt8, UInt16

from udccal.errors import FitError
from udccal.fitting.noise.codes import DarkPair, dark_pair
from udccal.fitting.noise.data import NoiseData
from udccal.fitting.noise.fit import converter_step, fit_noise_data
from udccal.fitting.noise.moments import PairMoments, StackMoments
from udccal.fitting.noise.pairs import reduce_pair
from udccal.fitting.noise.report import assumed_noise, failed
from udccal.fitting.noise.stacks import reduce_stack
from udccal.models.noise import Noise
from udccal.result import FitResult, FitStatus

# A level may hold frames of unlike size, until they are loaded: the sizes are not compared here.
Frame = UInt16[np.ndarray, "_rows _columns"] | UInt8[np.ndarray, "_rows _columns"] | Callable[[], np.ndarray]

_MOST_SIDE, _LEAST_SIDE = 65536, 16
_MOST_FRAMES = 4096
_THREADS = 2


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


@dataclass(frozen=True)
class SpatialStack:
    """Many frames alike, for the fixed pattern: dark and bright ones at one exposure (EMVA 1288, clause 8)."""

    exposure_s: float
    dark: Sequence[Frame]
    bright: Sequence[Frame]
    photons: float | None = None


def fit_noise_frames(
    levels: Sequence[ExposureLevel],
    stack: SpatialStack | None = None,
    *,
    bayer: bool = False,
    top_code: int | None = None,
) -> FitResult[Noise]:
    """Fit the noise term: K, black, saturation, dark noise and its shape, row noise, dark current, DSNU, PRNU.

    A curved response is found by itself: the result then has the estimate ``nonlinearity``, the share of the
    signal that is missing at full scale, and K is that of small signals.

    Args:
        levels: exposures; at least two with dark and three with bright pairs are needed.
        stack: frames for DSNU and PRNU; without it the pair nearest to half of saturation serves.
        bayer: the sensor carries a mosaic of 2 x 2 colours.
        top_code: the converter's largest code; the smallest 2^n - 1 that holds all codes where not given.

    Raises:
        FitError: when a frame is not a picture of codes like the others, or an exposure is no time.
    """
    return fit_noise_measured(measure_frames(levels, stack, bayer=bayer, top_code=top_code))


def fit_noise_measured(data: NoiseData | None) -> FitResult[Noise]:
    """Fit the noise term to what ``measure_frames`` gave; a status where that was nothing."""
    if data is None:
        return failed(_unknown(4095.0), FitStatus.TOO_FEW_DATA, "Expected dark and bright pairs of frames, found none.")
    return fit_noise_data(data, _unknown(data.top_DN))


def _unknown(top_DN: float) -> Noise:
    """What is assumed of a sensor of which nothing is known."""
    return assumed_noise(1.0, 0.0, top_DN)


def measure_frames(
    levels: Sequence[ExposureLevel],
    stack: SpatialStack | None = None,
    *,
    bayer: bool = False,
    top_code: int | None = None,
) -> NoiseData | None:
    """Reduce all frames to the moments and histograms that the fit needs; None without a dark and a bright pair.

    Args and errors: as ``fit_noise_frames``.
    """
    _check(levels, stack)
    darks = [level for level in levels if level.dark]
    brights = [level for level in levels if level.bright]
    if not darks or not brights:
        return None
    load = _Loader(_load(darks[0].dark[0]).shape)
    period = 2 if bayer else 1
    metered = all(level.photons is not None for level in brights) and (stack is None or stack.photons is not None)
    sample = load(brights[len(brights) // 2].bright[0])
    q_DN = converter_step(sample)
    with ThreadPoolExecutor(_THREADS) as pool:
        # The stacks are the longest tasks: they go first.
        stacks = (
            []
            if stack is None
            else [
                pool.submit(
                    reduce_stack,
                    [partial(load, f) for f in frames],
                    stack.exposure_s,
                    stack.photons if metered else None,
                    period,
                )
                for frames in (stack.bright, stack.dark)
            ]
        )
        flats = tuple(pool.map(lambda level: _bright(load, level, metered, period), brights))
        top = _top_code(flats, top_code, q_DN)
        dark = list(pool.map(lambda level: _dark(load, level, q_DN, top, period), darks))
        if stack is None:
            middle = _middle(brights, flats, top)
            near = min(darks, key=lambda level: abs(level.exposure_s - middle.exposure_s))
            stacks = [
                pool.submit(reduce_stack, [partial(load, f) for f in frames], level.exposure_s, None, period)
                for frames, level in ((middle.bright, middle), (near.dark, near))
            ]
        bright_stack, dark_stack = (task.result() for task in stacks)
    if stack is None:
        # The same pairs must not tell their variance twice.
        bright_stack, dark_stack = (StackMoments(s.exposure_s, s.mean_DN, s.frames) for s in (bright_stack, dark_stack))
    return NoiseData(
        darks=tuple(pair for pair, _ in dark),
        dark_rows=tuple(moments.rows for _, moments in dark),
        flats=flats,
        flat_stack=bright_stack,
        dark_stack=dark_stack,
        q_DN=q_DN,
        top_DN=float(top),
        period=period,
        dark_outliers=sum(moments.outliers for _, moments in dark),
    )


@dataclass(frozen=True)
class _Loader:
    """Loads a frame and refuses one that is not like the others."""

    shape: tuple[int, ...]

    def __call__(self, frame: Frame) -> UInt16[np.ndarray, "rows columns"]:
        array = _load(frame)
        if array.shape != self.shape:
            raise FitError(f"Expected frames of {self.shape} samples, found {array.shape}. Sort the frames by sensor.")
        return array if array.dtype == np.uint16 else array.astype(np.uint16)


def _load(frame: Frame) -> np.ndarray:
    array = frame() if callable(frame) else frame
    if not isinstance(array, np.ndarray) or array.dtype not in (np.uint8, np.uint16) or array.ndim != 2:
        found = f"{array.dtype} of shape {array.shape}" if isinstance(array, np.ndarray) else type(array).__name__
        raise FitError(f"Expected a frame as uint8 or uint16 array of rows x columns, found {found}. Pass raw codes.")
    if min(array.shape) < _LEAST_SIDE or max(array.shape) > _MOST_SIDE:
        raise FitError(f"Expected frames of {_LEAST_SIDE} to {_MOST_SIDE} samples a side, found {array.shape}.")
    return array


def _check(levels: Sequence[ExposureLevel], stack: SpatialStack | None) -> None:
    if len(levels) > _MOST_FRAMES or (stack is not None and max(len(stack.dark), len(stack.bright)) > _MOST_FRAMES):
        raise FitError(f"Expected at most {_MOST_FRAMES} levels and frames of a stack, found more. Average some first.")
    for index, level in enumerate(levels):
        if not (np.isfinite(level.exposure_s) and level.exposure_s >= 0):
            raise FitError(f"Expected level {index} to have an exposure in seconds, found {level.exposure_s}.")
        if level.photons is not None and not (np.isfinite(level.photons) and level.photons >= 0):
            raise FitError(f"Expected level {index} to have a number of photons, found {level.photons}.")
        for name, frames in (("dark", level.dark), ("bright", level.bright)):
            if len(frames) not in (0, 2):
                raise FitError(f"Expected two {name} frames in level {index} or none, found {len(frames)}.")
    if stack is not None and min(len(stack.dark), len(stack.bright)) < 2:
        raise FitError("Expected at least two dark and two bright frames in the stack, found fewer. Leave it out.")


def _bright(load: _Loader, level: ExposureLevel, metered: bool, period: int) -> PairMoments:
    first, second = (load(frame) for frame in level.bright)
    return reduce_pair(first, second, level.exposure_s, level.photons if metered else None, period)


def _dark(load: _Loader, level: ExposureLevel, q_DN: int, top: int, period: int) -> tuple[DarkPair, PairMoments]:
    first, second = (load(frame) for frame in level.dark)
    exposure_s = level.exposure_s
    return dark_pair(first, second, exposure_s, q_DN, top), reduce_pair(first, second, exposure_s, None, period)


def _top_code(flats: tuple[PairMoments, ...], declared: int | None, q_DN: int) -> int:
    peak = max(flat.peak_DN for flat in flats)
    if declared is None:
        return int(2 ** max(int(np.ceil(np.log2(peak + q_DN))), 8) - q_DN)
    if peak > declared:
        raise FitError(f"Expected codes up to {declared}, found {peak}. Give the converter's largest code as top_code.")
    return declared


def _middle(brights: list[ExposureLevel], flats: tuple[PairMoments, ...], top: int) -> ExposureLevel:
    """The level nearest to half of saturation."""
    levels = [float(np.mean(flat.mean_DN)) for flat in flats]
    ceiling = min(max(levels), float(top))
    return brights[int(np.argmin([abs(level - 0.5 * ceiling) for level in levels]))]
