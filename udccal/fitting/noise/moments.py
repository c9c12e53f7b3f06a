"""All frames of a noise measurement reduced to the data of the fit: moments, and joint histograms of dark codes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Literal, final

import numpy as np
from jaxtyping import Float

from udccal.arguments import check_kind
from udccal.errors import FitError
from udccal.fitting.noise.codes import DarkPair, converter_step, dark_pair
from udccal.fitting.noise.data import Averaged, Codes, ExposureLevel, NoiseData, NoiseRules, SpatialStack, loaded
from udccal.fitting.noise.frame_moments import Moments, reduce_frames, stacked

Grid = Float[np.ndarray, "levels bins"]


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
        expected = f"Expected dark frames darker than bright ones of at least their {exposure_s:.4g} s"
        found = f"found dark frames of {np.median(dark[::64]):.4g} DN and bright ones of at most {brightest:.4g} DN"
        raise FitError(f"{expected}, {found}. They may be exchanged.")


@final
@dataclass(frozen=True)
class NoiseMoments:
    """The frames, reduced.

    ``dark_moments`` are those of the pairs in ``darks``; both stacks have about the same exposure; colour sites repeat
    after ``period`` samples (1: monochrome). ``dark_seen`` and ``flat_seen`` are moments of the stacks' frames. They
    are None for an average that was made elsewhere, whose variance would include the lamp's flicker, and for frames of
    a pair, which must not count twice. ``rules`` are those of the whole fit. ``top_guessed``: ``top_DN`` was not given.
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
    top_guessed: bool = False

    @property
    def rounding_DN2(self) -> float:
        """Variance of white rounding."""
        return self.q_DN**2 / 12.0

    @property
    def dark_samples(self) -> int:
        """Number of samples in all histograms."""
        return sum(int(pair.counts.sum()) for pair in self.darks)


def steadied(flats: tuple[Moments, ...], variance_DN2: Grid, above_DN: Grid) -> Grid:
    """The variances of flats without what light that differs between the frames adds to them.

    Such frames differ, in addition to noise, by the bin's pattern (shading, PRNU) times that.
    """
    shift2 = np.stack([np.var(flat.shift_DN, axis=0, ddof=1) for flat in flats])
    pattern2 = np.maximum(stacked(flats, "spread_DN") ** 2 - variance_DN2, 0.0)
    pattern2 /= np.where(above_DN > 0, above_DN, np.inf) ** 2
    return np.maximum(variance_DN2 - shift2 * pattern2, 0.0)


def rough_gain(data: NoiseMoments, black_DN: float, dark_DN2: float) -> float:
    """Conversion gain in DN per electron from moments alone, for the first fit of the dark frames."""
    mean = stacked(data.flats, "mean_DN") - black_DN
    variance = stacked(data.flats, "variance_DN2") - data.rounding_DN2
    lit = mean > max(0.05 * mean.max(), 0.0)
    # Clipping lowers the ratio and nothing raises it.
    return max(float(np.quantile((variance[lit] - dark_DN2) / mean[lit], 0.75)), 1e-6) if lit.any() else 1.0


def reduced(data: NoiseData, rules: NoiseRules) -> NoiseMoments | None:
    """All frames as moments and histograms for the fit; None without a dark and a bright pair."""
    check_kind(data, NoiseData, "Give it levels of exposure.", FitError)
    data.check()
    darks, brights = ([of for of in data.levels if len(getattr(of, name))] for name in ("dark", "bright"))
    if not darks or not brights:
        return None
    stack, period = data.stack, 2 if data.bayer else 1

    def codes(kind: Literal["dark", "bright"], of: ExposureLevel | SpatialStack) -> Iterator[Codes]:
        whole = "stack" if of is stack else f"pair of {of.exposure_s:.4g} s"
        for number, frame in enumerate(getattr(of, kind)):
            yield loaded(frame, f"{kind} frame {number} of the {whole}", shape)

    shape: tuple[int, ...] = ()
    samples = [next(codes(*one)) for one in (("bright", brights[len(brights) // 2]), ("dark", darks[-1]))]
    shape = samples[0].shape
    # Converters with a step that grows with the signal show the smallest one in dark frames.
    steps = (converter_step(np.bincount(sample.ravel())) for sample in samples)
    q_DN = int(np.gcd.reduce([step for step in steps if step] or [1]))
    metered = all(level.photons is not None for level in brights) and (stack is None or stack.photons is not None)

    def seen(frames: Iterable[Codes], of: ExposureLevel | SpatialStack, dark_step: int = 0) -> tuple[Averaged, Moments]:
        return reduce_frames(frames, of.exposure_s, of.photons if metered else None, period, rules, dark_step)

    def dark(level: ExposureLevel) -> tuple[DarkPair, Moments]:
        first, second = codes("dark", level)
        _check_darker(first, level.exposure_s, flats)
        return dark_pair(first, second, level.exposure_s, q_DN, top), seen((first, second), level, q_DN)[1]

    def average(stack: SpatialStack, lit: bool) -> tuple[Averaged, Moments | None]:
        frames = stack.bright if lit else stack.dark
        if not isinstance(frames, Averaged):
            return seen(codes("bright" if lit else "dark", stack), stack, 0 if lit else q_DN)
        frames.check(shape)
        return frames, None

    with ThreadPoolExecutor(2) as pool:
        # The stacks are the longest tasks: they go first.
        tasks = [pool.submit(average, stack, lit) for lit in (False, True)] if stack else []
        flats = tuple(pool.map(lambda level: seen(codes("bright", level), level)[1], brights))
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
        stacks = [(seen(codes("dark", near), near)[0], None), (seen(codes("bright", middle), middle)[0], None)]
    (dark_stack, dark_seen), (flat_stack, flat_seen) = stacks
    frames = histograms, dark_moments, flats, dark_stack, flat_stack
    return NoiseMoments(*frames, q_DN, float(top), period, dark_seen, flat_seen, rules, data.top_code is None)
