"""Frames reduced to the data of the fit: moments per bin of pairs and stacks, and joint histograms of dark codes.

A bin is one site of the colour mosaic in one tile of the sensor. Frames come one by one: their differences from the
first frame are summed, and the squares of these, so that float32 loses no digits that matter.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import final

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int

from udccal.arguments import check_kind
from udccal.errors import FitError
from udccal.fitting.noise.codes import DarkPair, dark_pair, dark_window
from udccal.fitting.noise.data import (
    Averaged,
    Codes,
    ExposureLevel,
    Frame,
    NoiseData,
    NoiseRules,
    SpatialStack,
    checked_average,
    loaded,
)
from udccal.fitting.noise.neighbours import Shared, shared_noise

Grid = Float[np.ndarray, "groups_y groups_x"]


@functools.lru_cache(maxsize=8)
def bins(
    rows: int, columns: int, period: int
) -> tuple[Float[np.ndarray, "groups_y rows"], Float32[np.ndarray, "columns groups_x"]]:
    """Ones where a row and a column belong to a group of bins; colour sites repeat every ``period`` samples."""
    # Tiles keep shading and a lamp's slow flicker out of the variance: at most 8 a side, each of 4096 samples a colour.
    tiles = int(np.clip(np.sqrt(rows * columns / period**2 / 4096), 1, 8))

    def groups(length: int) -> Float[np.ndarray, "length groups"]:
        # Whole mosaic cells per tile; the last tile has the remaining ones.
        tile = np.minimum(np.arange(length) // period // max(length // period // tiles, 1), tiles - 1)
        return np.eye(tiles * period)[tile * period + np.arange(length) % period]

    return groups(rows).T.copy(), groups(columns).astype(np.float32)


@final
@dataclass(frozen=True)
class Moments:
    """Two or more frames of the same scene; arrays are per bin.

    ``light`` is the relative exposure to light, in any unit common to all levels (photons per pixel, or seconds).
    ``variance_DN2`` is the temporal variance of one frame, row noise and common changes of brightness removed, and
    ``dof`` its degrees of freedom; ``samples`` are frames times pixels; ``spread_DN`` is the standard deviation over
    these, spatial and temporal; ``shift_DN`` is the mean of each frame less that of all. ``rows_DN2`` is the variance
    of the rows' means, and ``sampling_DN2`` the part of it that is sampling; frames have ``height`` rows. ``at_peak``
    is the fraction of the samples with the largest code, and ``codes`` the histogram of the first frame. ``outliers``
    were hits, and left out; ``outlier_powers`` are the sums of the second and fourth powers of their differences from
    the first frame. ``shared`` is the noise that neighbours have in common in the first two frames. ``far`` is how many
    pixels lie outside the window of the dark histograms in both of these, and what they have of all frames' squares.
    ``repeated``: some frames are copies of others.
    """

    exposure_s: float
    light: float
    mean_DN: Float[np.ndarray, " bins"]
    variance_DN2: Float[np.ndarray, " bins"]
    dof: Float[np.ndarray, " bins"]
    samples: Float[np.ndarray, " bins"]
    spread_DN: Float[np.ndarray, " bins"]
    shift_DN: Float[np.ndarray, "frames bins"]
    rows_DN2: float
    sampling_DN2: float
    height: int
    peak_DN: int
    at_peak: Float[np.ndarray, " bins"]
    codes: Int[np.ndarray, " codes"]
    outliers: int
    outlier_powers: tuple[float, float]
    shared: Shared
    far: tuple[int, float] = (0, 0.0)
    repeated: bool = False

    @property
    def frames(self) -> int:
        """How many."""
        return len(self.shift_DN)

    @property
    def pixels(self) -> float:
        """Pixels of a frame."""
        return float(self.samples.sum()) / self.frames

    @property
    def temporal_DN2(self) -> float:
        """Temporal variance of all bins."""
        return float(np.average(self.variance_DN2, weights=self.dof))

    @property
    def near_DN2(self) -> float:
        """Temporal variance of the pixels that are not ``far``: hot and dead pixels have noise of their own."""
        (pixels, squares), dof = self.far, float(self.dof.sum())
        return (self.temporal_DN2 * dof - squares) / max(dof - (self.frames - 1) * pixels, 1.0)

    @property
    def outlier_variance_DN2(self) -> float:
        """What the hits would add to the temporal variance."""
        return self.outlier_powers[0] / (2 * (self.frames - 1) * self.pixels)


def stacked(levels: tuple[Moments, ...], name: str) -> Float[np.ndarray, "levels bins"]:
    """The field ``name`` of every level and bin."""
    return np.stack([getattr(level, name) for level in levels])


def reduce_frames(
    frames: Iterable[Codes],
    exposure_s: float,
    light: float | None,
    period: int,
    rules: NoiseRules,
    dark_step: int | None = None,
) -> tuple[Averaged, Moments]:
    """Mean per pixel, and temporal moments per bin without common changes of brightness and row noise.

    ``dark_step`` is the converter's step, of dark frames: pixels beyond the window of the histograms are ``far``.
    """
    source = iter(frames)
    first = next(source)
    (height, columns), (down, right) = first.shape, bins(*first.shape, period)

    def binned(picture: Float32[np.ndarray, "rows columns"]) -> Grid:
        return np.asarray(down @ (picture @ right))

    def at_peak(frame: Codes) -> tuple[int, Grid]:
        return int(top := frame.max()), binned((frame == top).astype(np.float32))

    width = right.sum(axis=0, dtype=np.float64)
    counts, total = np.outer(down.sum(axis=1), width), np.zeros(first.shape, np.float32)
    outliers, powers, squares = 0, np.zeros(2), np.zeros_like(counts)
    shared: Shared | None = None
    far, apart = np.zeros(0, int), [np.zeros(0)]
    # Of every frame: its rows' means and its bins' sums less these, as differences from the first frame, and its peak.
    by_row, by_bin, peaks = [np.zeros(height)], [np.zeros_like(counts)], [at_peak(first)]
    for frame in source:
        if dark_step and not shared:
            middle_DN, reach_DN = dark_step * np.array(dark_window(first, dark_step))
            far = np.flatnonzero(np.minimum(*(np.abs(one - middle_DN) for one in (first, frame))) > reach_DN)
            apart = [np.zeros(far.size)]
        difference = cv2.subtract(frame, first, dtype=cv2.CV_32F)
        square = cv2.multiply(difference, difference)
        # The usual difference is the median over some rows, which hits do not move; ten codes are never a hit.
        usual = np.median(square[:: max(height // 128, 1)] @ right, axis=0) / width
        hits = square > max(rules.hit_sigma**2 * float(usual.max()), 10.0**2)
        hits.ravel()[far] = False  # the shot noise of hot pixels is none
        if hits.any():
            large = square[hits].astype(np.float64)
            outliers, powers = outliers + large.size, powers + np.array([large.sum(), np.square(large).sum()])
            difference[hits] = 0.0
        by_row.append(difference.mean(axis=1, dtype=np.float64))
        difference -= by_row[-1][:, None]
        shared = shared or shared_noise(first, difference, period)
        apart.append(difference.ravel()[far].astype(np.float64))
        total += difference
        by_bin.append(binned(difference))
        squares += binned(cv2.multiply(difference, difference))
        peaks.append(at_peak(frame))
    number, middle = len(by_row), float(np.median(first[:: max(height // 64, 1)]))
    rows, left = np.stack(by_row), np.stack(by_bin)
    mean = cv2.addWeighted(first, 1.0, total, 1.0 / number, 0.0, dtype=cv2.CV_32F)
    mean += rows.mean(axis=0)[:, None]
    rows, left = rows - rows.mean(axis=0), left - left.mean(axis=0)
    dof = np.maximum((number - 1) * (counts * (1 - 1 / columns) - 1), 1.0)
    squares -= binned(cv2.multiply(total, total, scale=1.0 / number)) + np.square(left).sum(axis=0) / counts
    # The rows' means were taken from all of a row: a quiet bin beside noisy ones gains their part of the mean's
    # variance, v' (1 - 1/n) = v (1 - 2/n) + row average / n.
    mixed = squares / dof
    variance = (mixed * (1 - 1 / columns) - (mixed @ width)[:, None] / columns**2) / (1 - 2 / columns)
    about = cv2.subtract(mean, middle)
    level = binned(about) / counts
    spatial = np.maximum(binned(cv2.multiply(about, about)) / counts - level**2, 0.0)
    peak = max(code for code, _ in peaks)
    return Averaged(exposure_s, mean, number), Moments(
        exposure_s=exposure_s,
        light=exposure_s if light is None else light,
        mean_DN=(level + middle).ravel(),
        variance_DN2=variance.ravel(),
        dof=dof.ravel(),
        samples=number * counts.ravel(),
        spread_DN=np.sqrt(spatial + np.maximum(variance, 0.0) * (1 - 1 / number)).ravel(),
        shift_DN=((left + (rows @ down.T)[..., None] * width) / counts).reshape(number, -1),
        rows_DN2=float(np.square(rows - rows.mean(axis=1, keepdims=True)).sum()) / ((number - 1) * max(height - 1, 1)),
        sampling_DN2=float(np.average(variance, weights=counts)) / columns,
        height=height,
        peak_DN=peak,
        at_peak=(sum(count for code, count in peaks if code == peak) / (number * counts)).ravel(),
        codes=np.bincount(first.ravel()),
        outliers=outliers,
        outlier_powers=(float(powers[0]), float(powers[1])),
        shared=shared or Shared(),
        far=(far.size, float(np.var(apart, axis=0).sum()) * number),
    )


def fingerprint(frame: Codes) -> int | None:
    """A number that tells noisy frames apart; None where most pixels have one code, so that frames may well agree."""
    sample = frame[:: max(len(frame) // 64, 1)]
    low, high = np.percentile(sample, [16.0, 84.0])
    return hash(sample.tobytes()) if high > low else None


def converter_step(frame: Codes) -> int:
    """Smallest step between codes: greater than 1 where a converter's bits are shifted up in 16-bit samples."""
    codes = np.flatnonzero(np.bincount(frame.ravel(), minlength=2))
    return int(np.gcd.reduce(np.diff(codes))) if codes.size > 2 else 1


def _check_levels(flats: Sequence[Moments], darks: Sequence[Moments]) -> None:
    """A FitError where levels hold the same frames: moments of different frames never agree in all digits."""
    for name, levels in (("bright", flats), ("dark", darks)):
        # Frames of one code throughout, as in saturation, may agree.
        varied = [of.mean_DN.tobytes() + of.variance_DN2.tobytes() for of in levels if of.variance_DN2.any()]
        if len(set(varied)) < len(varied):
            expected = f"Expected other {name} frames in each level, found the same frames in several"
            raise FitError(f"{expected}. Each would count as a new measurement. Give each pair once.")


def _check_darker(dark: Codes, exposure_s: float, flats: Sequence[Moments]) -> None:
    """A FitError where a dark frame is brighter than every flat that is exposed at least as long.

    A flat collects as much dark current in that time. In a longer time, a dark frame may well collect more than the
    light of dim flats. Three quarters of the samples must be brighter: noise and rounding move a median.
    """
    brightest = max((float(of.mean_DN.mean()) for of in flats if of.exposure_s >= exposure_s), default=np.inf)
    if float(np.percentile(dark[::64], 25.0)) > brightest:
        found = f"dark frames of {np.median(dark[::64]):.4g} DN and bright ones of at most {brightest:.4g} DN"
        raise FitError(
            f"Expected dark frames darker than bright ones of at least their {exposure_s:.4g} s, found {found}. "
            "They may be exchanged."
        )


@final
@dataclass(frozen=True)
class NoiseMoments:
    """The frames, reduced.

    ``dark_moments`` are those of the pairs in ``darks``; both stacks have about the same exposure; colour sites repeat
    after ``period`` samples (1: monochrome). ``dark_seen`` and ``flat_seen`` are moments of the stacks' frames. They
    are None for an average that was made elsewhere, whose variance would include the lamp's flicker, and for frames of
    a pair, which must not count twice. ``rules`` are those of the whole fit.
    """

    darks: tuple[DarkPair, ...]
    dark_moments: tuple[Moments, ...]
    flats: tuple[Moments, ...]
    dark_stack: Averaged
    flat_stack: Averaged
    q_DN: int
    top_DN: float
    period: int = 2
    dark_seen: Moments | None = None
    flat_seen: Moments | None = None
    rules: NoiseRules = field(default_factory=NoiseRules)

    @property
    def rounding_DN2(self) -> float:
        """Variance of white rounding."""
        return self.q_DN**2 / 12.0

    @property
    def dark_samples(self) -> int:
        """Number of samples in all histograms."""
        return sum(int(pair.counts.sum()) for pair in self.darks)


def reduced(data: NoiseData, rules: NoiseRules) -> NoiseMoments | None:
    """All frames as moments and histograms for the fit; None without a dark and a bright pair."""
    check_kind(data, NoiseData, "Give it levels of exposure.", FitError)
    data.check()
    darks, brights = ([of for of in data.levels if len(getattr(of, name))] for name in ("dark", "bright"))
    if not darks or not brights:
        return None
    stack, period = data.stack, 2 if data.bayer else 1
    sample = loaded(brights[len(brights) // 2].bright[0])
    q_DN = converter_step(sample)
    metered = all(level.photons is not None for level in brights) and (stack is None or stack.photons is not None)

    def moments(
        frames: Iterable[Frame], exposure_s: float, photons: float | None = None, dark_step: int | None = None
    ) -> tuple[Averaged, Moments]:
        marks: list[int] = []

        def checked() -> Iterator[Codes]:
            for frame in frames:
                yield (codes := loaded(frame, sample.shape))
                if mark := fingerprint(codes):
                    marks.append(mark)

        mean, found = reduce_frames(checked(), exposure_s, photons if metered else None, period, rules, dark_step)
        return mean, replace(found, repeated=len(set(marks)) < len(marks))

    def dark(level: ExposureLevel) -> tuple[DarkPair, Moments]:
        first, second = (loaded(frame, sample.shape) for frame in level.dark)
        _check_darker(first, level.exposure_s, flats)
        own = moments((first, second), level.exposure_s, dark_step=q_DN)[1]
        return dark_pair(first, second, level.exposure_s, q_DN, top), own

    def average(
        stack: SpatialStack, frames: Iterable[Frame] | Averaged, dark_step: int | None
    ) -> tuple[Averaged, Moments | None]:
        if isinstance(frames, Averaged):
            return checked_average(frames, sample.shape), None
        return moments(frames, stack.exposure_s, stack.photons, dark_step)

    with ThreadPoolExecutor(2) as pool:
        # The stacks are the longest tasks: they go first.
        both = ((stack, stack.dark, q_DN), (stack, stack.bright, None)) if stack else ()
        tasks = [pool.submit(average, *one) for one in both]
        flats = tuple(pool.map(lambda level: moments(level.bright, level.exposure_s, level.photons)[1], brights))
        peak = max(flat.peak_DN for flat in flats)
        possible = int(2 ** max(int(np.ceil(np.log2(peak + q_DN))), 8) - q_DN)
        top = possible if data.top_code is None else data.top_code
        if peak > top:
            raise FitError(f"Expected codes up to {top}, found {peak}. Give the converter's largest code as top_code.")
        histograms, dark_moments = zip(*pool.map(dark, darks), strict=True)
        stacks = [task.result() for task in tasks]
    _check_levels(flats, dark_moments)
    if not stacks:
        means = np.array([flat.mean_DN.mean() for flat in flats])
        middle = brights[int(np.argmin(np.abs(means - 0.5 * min(means.max(), top))))]
        near = min(darks, key=lambda level: abs(level.exposure_s - middle.exposure_s))
        stacks = [(moments(near.dark, near.exposure_s)[0], None), (moments(middle.bright, middle.exposure_s)[0], None)]
    (dark_stack, dark_seen), (flat_stack, flat_seen) = stacks
    pairs = histograms, dark_moments, flats
    return NoiseMoments(*pairs, dark_stack, flat_stack, q_DN, float(top), period, dark_seen, flat_seen, rules)
