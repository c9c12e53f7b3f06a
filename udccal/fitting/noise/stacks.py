"""Frames that cannot be what they are given as: copies, and stacks that contradict the pairs.

The limits are wide: light, temperature and black may drift between the pairs and a stack.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from udccal.fitting.noise.flats import rough_gain, steadied
from udccal.fitting.noise.frame_moments import Moments, stacked
from udccal.fitting.noise.moments import NoiseMoments

_SORT = "Sort the stack's frames, or leave the stack out."


def contradiction(data: NoiseMoments) -> str | None:
    """A sentence on frames that cannot be what they are given as; None where nothing is wrong."""
    return next((wrong for test in (_copies, _dark_stack, _flat_stack) for wrong in test(data)), None)


def _copies(data: NoiseMoments) -> Iterator[str]:
    """Noise never repeats: copies show none, and count as new measurements. Flats tell it by their variance."""
    for name, seen in (("dark stack", data.dark_seen), ("flat stack", data.flat_seen)):
        if seen is not None and seen.repeated:
            expected = f"Expected noise between the {seen.frames} frames of the {name}, found copies of one frame"
            yield f"{expected}. Give each frame once."
    if twice := [of.exposure_s for of in data.dark_moments if of.repeated]:
        found = f"copies of one frame at {len(twice)} exposures (the first of {twice[0]:.4g} s)"
        yield f"Expected noise between the two frames of dark pairs, found {found}. Give two frames that were taken."


def _dark_stack(data: NoiseMoments) -> Iterator[str]:
    """The dark stack has the mean and the temporal noise of dark pairs, and is darker than the flats."""
    pairs, stack, rounding = sorted(data.dark_moments, key=lambda of: of.exposure_s), data.dark_stack, data.rounding_DN2
    means, times = np.array([_mean_DN(of) for of in pairs]), np.array([of.exposure_s for of in pairs])
    mean, usual = float(stack.mean_DN.mean()), float(np.interp(stack.exposure_s, times, means))
    noise = float(np.interp(stack.exposure_s, times, [of.temporal_DN2 for of in pairs]))
    drift = abs(usual - float(means.min())) + 3.0 * float(np.sqrt(noise + rounding))
    # Outside the pairs' exposures, dark current changes as it does within; one exposure does not show how much.
    outside, apart = max(stack.exposure_s - float(times[-1]), float(times[0]) - stack.exposure_s, 0.0), np.ptp(times)
    if outside > 0:
        drift += 1.5 * outside * float(np.ptp(means) / apart) if apart > 0 else np.inf
    if abs(mean - usual) > drift:
        why = "some of its frames may be lit" if mean > usual else "black may be subtracted from it"
        found = f"found {mean:.4g} DN: {why}"
        yield f"Expected a dark stack of about {usual:.4g} DN, as the dark pairs, {found}. {_SORT}"
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
    black, quiet = min((_mean_DN(of), of.temporal_DN2) for of in data.dark_moments)
    seen, stack, flats = data.flat_seen, data.flat_stack, data.flats
    signals, mean = np.array([_mean_DN(of) - black for of in flats]), float(stack.mean_DN.mean()) - black
    by_time = all(of.light == of.exposure_s for of in flats)
    light = seen.light if seen is not None else stack.exposure_s * by_time
    rates = [signal / of.light for signal, of in zip(signals, flats, strict=True) if of.light > 0]
    # Brighter ones do no harm, and full pixels are as bright as any.
    usual = min(min(rates, default=0.0) * light, float(signals.max()))
    if mean < 0.5 * usual - 3.0 * float(np.sqrt(quiet + data.rounding_DN2)):
        yield (
            f"Expected a flat stack {usual:.4g} DN above black, as flats of its exposure, found {mean:.4g} DN: some of "
            f"its frames may be dark. {_SORT}"
        )
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
        yield (
            f"{expected}, as in {name} pairs, found {variance_DN2:.3g} DN^2: its frames may be copies, averages, or of "
            f"several scenes. {_SORT}"
        )


def _mean_DN(of: Moments) -> float:
    return float(np.average(of.mean_DN, weights=of.samples))
