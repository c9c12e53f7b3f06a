"""Frames that cannot be what they are given as: copies, pairs unlike the others, stacks that contradict the pairs."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from udccal.fitting.noise.frame_moments import stacked
from udccal.fitting.noise.moments import NoiseMoments, rough_gain, steadied

PerPair = Float[np.ndarray, " pairs"]
# Part by which flats about as bright as a stack differ from it.
_ALIKE = 0.25
# The limits are wide: light, temperature and black may drift between the pairs and a stack.
_SORT = "Sort the stack's frames, or leave the stack out."


def contradiction(data: NoiseMoments) -> str | None:
    """A sentence on frames that cannot be what they are given as; None where nothing is wrong."""
    tests = _copies, _stuck_pair, _unlike_pair, _dark_stack, _flat_stack, _averages
    return next((wrong for test in tests for wrong in test(data)), None)


def _copies(data: NoiseMoments) -> Iterator[str]:
    """Noise never repeats: copies show none, and count as new measurements. Flats tell it by their variance."""
    for name, seen in (("dark stack", data.dark_seen), ("flat stack", data.flat_seen)):
        if seen is not None and seen.repeated:
            expected = f"Expected noise between the {seen.frames} frames of the {name}"
            yield f"{expected}, found copies of one frame. Give each frame once."
    if twice := [of.exposure_s for of in data.dark_moments if of.repeated]:
        found = f"copies of one frame at {len(twice)} exposures (the first of {twice[0]:.4g} s)"
        yield f"Expected noise between the two frames of dark pairs, found {found}. Give two frames that were taken."
    for name, pairs in (("dark", data.dark_moments), ("bright", data.flats)):
        if torn := [of for of in pairs if of.torn]:
            expected = f"Expected noise between all rows of two {name} frames of {torn[0].exposure_s:.4g} s"
            found = f"found {torn[0].torn} of {torn[0].height} rows of one frame in the other: they are torn"
            yield f"{expected}, {found}. Take that pair again, or leave it out."


def _stuck_pair(data: NoiseMoments) -> Iterator[str]:
    """A dark pair of hardly more than one code, where all others vary: noise does not fall with exposure.

    Of noise far below a code, rounding leaves a quarter of a step squared or nothing, as it happens.
    """
    times, means, noise = _of_darks(data)
    for k in np.flatnonzero(noise < data.rules.stuck * np.median(noise)):
        others = np.arange(len(noise)) != k
        # The mean code of a stuck pair says nothing of dark current, unless there is but one other.
        seen = others | (len(noise) < 3)
        rate = max(float(np.polyfit(times[seen], means[seen], 1)[0]), 0.0) if np.ptp(times[seen]) > 0 else 0.0
        # Longer exposures have more of dark current's shot noise; twice of it, as the gain is a rough one.
        shot = 2 * rough_gain(data, float(means[others].min()), float(noise[others].min())) * rate
        usual = float(np.min(noise[others] - shot * np.maximum(times[others] - times[k], 0.0)))
        if noise[k] < data.rules.stuck * usual and usual > 0.3 * data.q_DN**2:
            expected = f"Expected a temporal variance of about {usual:.3g} DN^2 in dark frames of {times[k]:.4g} s"
            found = f"found {noise[k]:.3g} DN^2 about the code {means[k]:.4g}: they may be stuck"
            yield f"{expected}, as in the others, {found}. Take that pair again, or leave it out."


def _unlike_pair(data: NoiseMoments) -> Iterator[str]:
    """A dark pair that is too bright beside another, or beside a flat: dark current collects in proportion to time.

    It collects in flats as well, and in no time less than linearly as pixels fill.
    """
    count, every = len(data.dark_moments), (*data.dark_moments, *data.flats)
    times, means = np.array([(of.exposure_s, of.level_DN) for of in every]).T
    noise = float(np.median([of.temporal_DN2 for of in data.dark_moments])) + data.rounding_DN2
    above = np.maximum(means - means[:count].min(), 0.0) + 5.0 * (float(np.sqrt(noise)) + data.q_DN)
    later = np.maximum(times - times[:count].min(), 0.0)
    longer = np.maximum(later[:count, None] / np.maximum(later, 1e-12), 1.0)
    bright = above[:count, None] > data.rules.apart * above * longer
    contradicted = bright.sum(axis=1) + bright[:, :count].sum(axis=0)
    if (most := int(contradicted.max())) > 0:
        # Where two contradict each other alone, light is likelier in the brighter one.
        k = max(np.flatnonzero(contradicted == most), key=lambda pair: means[pair])
        other = int(np.argmax(bright[k])) if bright[k].any() else int(np.argmax(bright[:, k]))
        name, why = "dark" if other < count else "bright", "They may be lit, or exchanged, or their time is wrong"
        expected = f"Expected dark frames that brighten in proportion to exposure, found {means[k]:.4g} DN at"
        found = f"{times[k]:.4g} s beside {means[other]:.4g} DN in {name} frames of {times[other]:.4g} s"
        yield f"{expected} {found}. {why}. Sort the frames, or leave the dark ones of {times[k]:.4g} s out."


def _of_darks(data: NoiseMoments) -> tuple[PerPair, PerPair, PerPair]:
    """Exposure, mean and temporal variance of every dark pair."""
    times, means, noise = np.array([(of.exposure_s, of.level_DN, of.temporal_DN2) for of in data.dark_moments]).T
    return times, means, noise


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


def _averages(data: NoiseMoments) -> Iterator[str]:
    """Pixels of an average made elsewhere differ by their temporal noise over its number of frames, or by more."""
    for name, stack, seen, pairs in (
        ("dark", data.dark_stack, data.dark_seen, data.dark_moments),
        ("flat", data.flat_stack, data.flat_seen, data.flats),
    ):
        if seen is not None:
            continue
        levels, noise = np.array(sorted((of.level_DN, of.temporal_DN2) for of in pairs)).T
        mean = float(stack.mean_DN.mean())
        # Full pixels have hardly any noise: the quietest of the pairs about as bright counts, none beyond all.
        if mean > levels.max() + float(np.sqrt(noise.max())):
            continue
        alike = noise[np.abs(levels - mean) <= _ALIKE * mean]
        usual = float(alike.min()) if alike.size else float(np.interp(mean, levels, noise))
        least = max(usual - data.rounding_DN2, 0.0) / stack.frames
        beside = stack.mean_DN[:, data.period :] - stack.mean_DN[:, : -data.period]
        found2 = float(np.var(beside)) / 2
        # Rounding, and the mean of two frames without their common noise, leave less.
        if found2 < data.rules.quiet * least - data.rounding_DN2 / stack.frames:
            expected = f"Expected pixels of the {name} average to differ by {least**0.5:.3g} DN at least, as those of"
            found = f"{stack.frames} frames do, found {found2**0.5:.3g} DN"
            yield f"{expected} {found}: it may be the mean of more frames, or smoothed. Give the number that it has."


def _unlike(name: str, variance_DN2: float, low_DN2: float, high_DN2: float, rounding_DN2: float) -> Iterator[str]:
    # The variance of rounding depends on where the mean lies between two codes: up to a quarter of a step squared.
    low_DN2, high_DN2 = low_DN2 - 3 * rounding_DN2, high_DN2 + 3 * rounding_DN2
    if not low_DN2 <= variance_DN2 <= high_DN2:
        expected = f"Expected a temporal variance of {max(low_DN2, 0.0):.3g} to {high_DN2:.3g} DN^2 in the {name} stack"
        found = f"found {variance_DN2:.3g} DN^2: its frames may be copies, averages, or of several scenes"
        yield f"{expected}, as in {name} pairs, {found}. {_SORT}"
