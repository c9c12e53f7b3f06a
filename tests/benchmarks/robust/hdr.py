"""Brackets of every kind: light over decades, gains, converters, hits, and noise models or times that are wrong."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt16
from scipy.stats import poisson

from tests.benchmarks.robust.family import Answer, Case, Family, Number, all_finite
from udccal.fitting.hdr.merge import HdrMerge, merge_bracket
from udccal.models.noise import Noise
from udccal.result import FitStatus

_PIXELS, _GROUPS = 12_000, 20
# Offsets and widths of a group of pixels that nobody can notice, in a pixel's sigma.
_OFFSET, _WIDTH = 0.1, 0.15
# A note with this word says that rounding moves dark pixels.
_ROUNDING = ("rounding",)


@dataclass(frozen=True)
class Bracket:
    """A sensor as it is, its exposures, and what the merge is told of both.

    ``hits`` is the part of the samples that radiation hits; ``lamp`` is the light of each frame, 1 as in the others.
    """

    sensor: Noise
    told: Noise
    exposures_s: Float[np.ndarray, " n"]
    told_s: Float[np.ndarray, " n"]
    lamp: Float[np.ndarray, " n"]
    rates: Float[np.ndarray, " pixels"]
    hits: float
    offsets_e: Float[np.ndarray, " pixels"]


def draw(seed: int) -> Case:
    """A sensor, a bracket, and in half of the sets something wrong."""
    rng = np.random.default_rng([seed, 17])
    top = 2.0 ** int(rng.choice([8, 10, 12, 14, 16])) - 1
    read = float(np.exp(rng.uniform(np.log(0.3), np.log(10.0))))
    # From an eighth of a code of dark noise up to 20 codes, over a range of at least 20 times it and of 300 electrons.
    K = min(float(np.exp(rng.uniform(np.log(0.12), np.log(20.0)))), top / 60) / read
    K = min(K, top / 300)
    black, full = (
        6 * K * read + float(rng.uniform(2, 0.02 * top + 3)),
        top - float(rng.choice([0.0, 0.05])) * top,
    )
    count, step = int(rng.integers(1, 11)), float(rng.uniform(1.6, 6.0))
    times = 1e-4 * np.exp(rng.uniform(0, 4)) * step ** np.arange(count)
    # The brightest pixel is up to ten times beyond the shortest exposure; the darkest has a tenth of the dark noise.
    brightest = (full - black) / K / times[0] * float(np.exp(rng.uniform(np.log(0.05), np.log(10.0))))
    darkest = max(min(read / times[-1] * float(rng.uniform(0.1, 3.0)), 0.1 * brightest), 1e-5 * brightest)
    rates = np.exp(rng.uniform(np.log(darkest), np.log(brightest), _PIXELS))
    sensor = Noise(K, black, full, read, 0.14, 0.0, 1.0, float(rng.choice([0.0, 20.0])), 0.0, 0.0)
    # Draws of their own, so that a set's other numbers do not depend on them.
    uneven = np.random.default_rng([seed, 19])
    sensor = _with(sensor, DSNU1288_e=float(uneven.choice([0.0, uneven.uniform(0.0, read)])))
    offsets_e = sensor.DSNU1288_e * uneven.standard_normal(_PIXELS)
    hits = float(rng.choice([0.0, rng.uniform(0.0, 1e-3)]))
    wrong = str(rng.choice(["K", "black", "time", "lamp"])) if count >= 4 and rng.random() < 0.5 else ""
    off, frame = float(rng.choice([-1.0, 1.0]) * rng.uniform(0.1, 0.4)), int(rng.integers(0, count))
    told, told_s, lamp = sensor, times.copy(), np.ones(count)
    if wrong == "K":
        told = _with(sensor, K_DN_per_e=K * (1 + off))
    elif wrong == "black":
        told = _with(sensor, black_DN=black + math.copysign(max(5 * abs(off) * K * read, 0.3), off))
    elif wrong == "time":
        told_s[frame] *= 1 + off
    elif wrong == "lamp":
        lamp[frame] += off
    what = f"{wrong} {off:+.0%}" if wrong else "nothing wrong"
    what = f"{what}, {count} x {step:.1f}, K {K:.3g}, read {read:.2g} e, {math.log2(top + 1):.0f} bit, hits {hits:.1e}"
    what = f"{what}, DSNU {sensor.DSNU1288_e:.2g} e"
    bracket = Bracket(sensor, told, times, told_s, lamp, rates, hits, offsets_e)
    return Case(what, functools.partial(answer, bracket, seed), sound=not wrong)


def _with(noise: Noise, **changes: float) -> Noise:
    return Noise(**{name: changes.get(name, getattr(noise, name)) for name in Noise.__dataclass_fields__})


def codes(bracket: Bracket, rng: np.random.Generator) -> UInt16[np.ndarray, "n pixels"]:
    """Frames of one row."""
    sensor, times = bracket.sensor, bracket.exposures_s[:, None]
    expected = (bracket.rates * bracket.lamp[:, None] + sensor.dark_current_e_per_s) * times
    # Counts of more than any converter's range need no draw; a normal one is as good.
    counts = rng.poisson(np.minimum(expected, 1e9)).astype(np.float64)
    hit = rng.random(counts.shape) < bracket.hits
    counts += hit * np.exp(rng.uniform(np.log(100.0), np.log(2e4), counts.shape))
    light = counts + bracket.offsets_e + sensor.sigma_d_e * rng.standard_normal(counts.shape)
    signal = np.rint(sensor.black_DN + sensor.K_DN_per_e * light)
    return np.clip(signal, 0, np.floor(sensor.saturation_DN)).astype(np.uint16)


def answer(bracket: Bracket, seed: int) -> Answer:
    """Of the merge, by groups of pixels of like light: a pixel of few electrons has its sigma at its own noisy rate."""
    merged = merge_bracket(codes(bracket, np.random.default_rng([seed, 18])), bracket.told_s, bracket.told)
    notes = (*merged.notes, *([merged.status.value] if merged.status is not FitStatus.CONVERGED else []))
    finite = all_finite(merged.rate_e_per_s, merged.sigma_e_per_s)
    return Answer(merged.status is FitStatus.CONVERGED, notes, _groups(bracket, merged), finite)


def _groups(bracket: Bracket, merged: HdrMerge) -> tuple[Number, ...]:
    # Light that every exposure may clip is unknown; what is left unclipped by chance is the low part of its kind.
    sensor, electrons = bracket.sensor, (bracket.rates + bracket.sensor.dark_current_e_per_s) * bracket.exposures_s[0]
    level = (sensor.saturation_DN - sensor.black_DN) / sensor.K_DN_per_e - 6 * np.hypot(
        sensor.sigma_d_e, 0.3 / sensor.K_DN_per_e
    )
    known = electrons + 5 * np.sqrt(electrons + sensor.sigma_d_e**2) < level
    order = np.flatnonzero(known)[np.argsort(bracket.rates[known])]
    false = (
        sum(found.count for found in merged.outliers if "pixels" in found.rule)
        - bracket.hits * bracket.lamp.size * _PIXELS
    )
    numbers = [
        Number(
            "good pixels listed as hits",
            max(false, 0.0),
            1 + 3e-5 * _PIXELS + math.sqrt(_PIXELS * bracket.hits * bracket.lamp.size),
        )
    ]
    for group in np.array_split(order, _GROUPS) if len(order) >= 20 * _GROUPS else ():
        error = merged.rate_e_per_s[group] - bracket.rates[group]
        # Rates spread within a group: each pixel's error in its own sigma, at the sigma of all of the same light.
        z = error / _smooth(merged.sigma_e_per_s[group])
        # A hit of less than six sigma is not seen, nor any where a pixel has fewer than three samples; more hits than
        # there can be would be.
        most = int(poisson.ppf(1 - 1e-6, bracket.hits * len(z) * len(bracket.told_s)))
        z = z[np.argsort(np.abs(z))][: len(z) - max(1, most)]
        light, count = float(np.median(bracket.rates[group])), len(z)
        offset, width = float(z.mean()), float(np.sqrt(np.mean(z**2))) - 1
        numbers += [
            Number(f"rate about {light:.2g} e/s", _beyond(offset, _OFFSET), count**-0.5, words=_ROUNDING),
            Number(
                f"sigma about {light:.2g} e/s", _beyond(max(width, 0.0), _WIDTH), (2 * count) ** -0.5, words=_ROUNDING
            ),
        ]
    return tuple(numbers)


def _beyond(value: float, unnoticed: float) -> float:
    return math.copysign(max(abs(value) - unnoticed, 0.0), value)


def _smooth(sigma: Float[np.ndarray, " group"]) -> Float[np.ndarray, " group"]:
    """Root mean square over the nearest pixels in light, which are sorted."""
    kernel = np.ones(25)
    return np.sqrt(np.convolve(sigma**2, kernel, "same") / np.convolve(np.ones(len(sigma)), kernel, "same"))


FAMILY = Family("hdr", draw)
