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
    return NoiseMoments(*frames, q_DN, float(top), period, dark_seen, flat_seen, rules)


# What cannot be what it is given as: copies, and stacks that contradict the pairs. The limits are wide: light,
# temperature and black may drift between the pairs and a stack.
_SORT = "Sort the stack's frames, or leave the stack out."


def contradiction(data: NoiseMoments) -> str | None:
    """A sentence on frames that cannot be what they are given as; None where nothing is wrong."""
    return next((wrong for test in (_copies, _dark_stack, _flat_stack) for wrong in test(data)), None)


def _copies(data: NoiseMoments) -> Iterator[str]:
    """Noise never repeats: copies show none, and count as new measurements. Flats tell it by their variance."""
    for name, seen in (("dark stack", data.dark_seen), ("flat stack", data.flat_seen)):
        if seen is not None and seen.repeated:
            expected = f"Expected noise between the {seen.frames} frames of the {name}"
            yield f"{expected}, found copies of one frame. Give each frame once."
    if twice := [of.exposure_s for of in data.dark_moments if of.repeated]:
        found = f"copies of one frame at {len(twice)} exposures (the first of {twice[0]:.4g} s)"
        yield f"Expected noise between the two frames of dark pairs, found {found}. Give two frames that were taken."


def _dark_stack(data: NoiseMoments) -> Iterator[str]:
    """The dark stack has the mean and the temporal noise of dark pairs, and is darker than the flats."""
    pairs, stack, rounding = sorted(data.dark_moments, key=lambda of: of.exposure_s), data.dark_stack, data.rounding_DN2
    means, times = np.array([of.level_DN for of in pairs]), np.array([of.exposure_s for of in pairs])
    mean, usual = float(stack.mean_DN.mean()), float(np.interp(stack.exposure_s, times, means))
    noise = float(np.interp(stack.exposure_s, times, [of.temporal_DN2 for of in pairs]))
    drift = abs(usual - float(means.min())) + 3.0 * float(np.sqrt(noise + rounding))
    # Outside the pairs' exposures, dark current changes as it does within; one exposure does not show how much.
    outside, apart = max(stack.exposure_s - float(times[-1]), float(times[0]) - stack.exposure_s, 0.0), np.ptp(times)
    if outside > 0:
        drift += 1.5 * outside * float(np.ptp(means) / apart) if apart > 0 else np.inf
    if abs(mean - usual) > drift:
        why = "some of its frames may be lit" if mean > usual else "black may be subtracted from it"
        yield f"Expected a dark stack of about {usual:.4g} DN, as the dark pairs, found {mean:.4g} DN: {why}. {_SORT}"
    flat = float(data.flat_stack.mean_DN.mean())
    if mean > flat + 3.0 * float(np.sqrt(noise + rounding)) and stack.exposure_s <= data.flat_stack.exposure_s:
        found = f"{mean:.4g} DN and a flat stack of {flat:.4g} DN: they may be exchanged"
        yield f"Expected a dark stack darker than the flat stack, found {found}. {_SORT}"
    if (seen := data.dark_seen) is not None:
        more = (mean - usual) * rough_gain(data, float(means[0]), noise)
        low, high = 0.5 * (noise + min(more, 0.0)), 2.0 * (noise + max(more, 0.0))
        yield from _unlike("dark", seen.temporal_DN2, low, high, rounding)


def _flat_stack(data: NoiseMoments) -> Iterator[str]:
    """The flat stack has the light that flats of its exposure have, and their temporal noise."""
    black, quiet = min((of.level_DN, of.temporal_DN2) for of in data.dark_moments)
    seen, stack, flats = data.flat_seen, data.flat_stack, data.flats
    signals, mean = np.array([of.level_DN - black for of in flats]), float(stack.mean_DN.mean()) - black
    by_time = all(of.light == of.exposure_s for of in flats)
    light = seen.light if seen is not None else stack.exposure_s * by_time
    rates = [signal / of.light for signal, of in zip(signals, flats, strict=True) if of.light > 0]
    # Brighter ones do no harm, and full pixels are as bright as any.
    usual = min(min(rates, default=0.0) * light, float(signals.max()))
    if mean < 0.5 * usual - 3.0 * float(np.sqrt(quiet + data.rounding_DN2)):
        expected = f"Expected a flat stack {usual:.4g} DN above black, as flats of its exposure"
        yield f"{expected}, found {mean:.4g} DN: some of its frames may be dark. {_SORT}"
    if seen is not None:
        every = (*flats, seen)
        above = stacked(every, "mean_DN") - black
        steady = steadied(every, stacked(every, "variance_DN2"), above)
        temporal = np.average(steady, axis=1, weights=stacked(every, "dof"))
        own, signals, noise = float(temporal[-1]), np.append(signals, 0.0), np.append(temporal[:-1], quiet)
        # Between the noise of the next dimmer and the next brighter flat, which falls where pixels are full.
        dimmer, brighter = signals <= mean, signals >= mean
        below = np.argmax(np.where(dimmer, signals, -np.inf)) if dimmer.any() else -1
        next_up = float(noise[np.argmin(np.where(brighter, signals, np.inf))]) if brighter.any() else 0.0
        risen = float(noise[below]) + rough_gain(data, black, quiet) * max(mean - float(signals[below]), 0.0)
        low, high = min(float(noise[below]), next_up), max(risen, next_up)
        yield from _unlike("flat", own, 0.7 * low, 1.4 * high, data.rounding_DN2)


def _unlike(name: str, variance_DN2: float, low_DN2: float, high_DN2: float, rounding_DN2: float) -> Iterator[str]:
    # The variance of rounding depends on where the mean lies between two codes: up to a quarter of a step squared.
    low_DN2, high_DN2 = low_DN2 - 3 * rounding_DN2, high_DN2 + 3 * rounding_DN2
    if not low_DN2 <= variance_DN2 <= high_DN2:
        expected = f"Expected a temporal variance of {max(low_DN2, 0.0):.3g} to {high_DN2:.3g} DN^2 in the {name} stack"
        found = f"found {variance_DN2:.3g} DN^2: its frames may be copies, averages, or of several scenes"
        yield f"{expected}, as in {name} pairs, {found}. {_SORT}"
