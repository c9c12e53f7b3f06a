"""All frames of a noise measurement reduced to the data of the fit: moments, and joint histograms of dark codes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import final

import numpy as np

from udccal.arguments import check_kind
from udccal.errors import FitError
from udccal.fitting.noise.codes import DarkPair, dark_pair
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
from udccal.fitting.noise.frame_moments import Moments, reduce_frames


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
