"""Exposure brackets to one linear picture: maximum likelihood with the sensor's noise model."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import final

import jax
import numpy as np
from jaxtyping import Bool, Float, Int, UInt16

from udccal.errors import FitError
from udccal.fitting.engine.robust import outliers
from udccal.fitting.hdr.likelihood import BlockMerge, HdrRules, SensorNumbers, merge_block
from udccal.models.noise import Noise
from udccal.result import FitStatus, Outliers

# What sigma says where no sample could be used: larger than any rate a sensor can tell, and finite.
UNKNOWN_SIGMA = 1e12
# Pixels of one compiled pass: large pictures, and crops.
_BLOCKS = (1 << 16, 1 << 12)
_THREADS = 2


@final
@dataclass(frozen=True)
class HdrMerge:
    """A picture of one still scene, from a bracket.

    Attributes:
        rate_e_per_s, sigma_e_per_s: light of every pixel, with one standard deviation.
        used: samples that each pixel rests on; where there are none the rate is 0 and sigma ``UNKNOWN_SIGMA``.
        outliers: frames and samples that were left out.
        status: SATURATED where no pixel has a sample that could be used.
        notes: sentences for a person.
    """

    rate_e_per_s: Float[np.ndarray, "*picture"]
    sigma_e_per_s: Float[np.ndarray, "*picture"]
    used: Int[np.ndarray, "*picture"]
    outliers: tuple[Outliers, ...] = ()
    status: FitStatus = FitStatus.CONVERGED
    notes: tuple[str, ...] = ()


def merge_bracket(
    frames: UInt16[np.ndarray, "n *picture"],
    exposures_s: Float[np.ndarray, " exposures"],
    noise: Noise,
    rules: HdrRules | None = None,
) -> HdrMerge:
    """Merge frames of one still scene at several exposures (repeats allowed).

    Solves the likelihood equation of ``hdr.likelihood`` for each pixel: shot, dark and quantisation noise at the
    merged rate (weights from single noisy samples would pull dark pixels down), samples within 6 sigma of saturation
    as censored. In single precision, which moves no rate by a thousandth of its sigma; compiled once per number
    of frames.

    Left out and listed are frames whose light is off by more than 2 % (a lamp that flickered, a dropped frame), and
    single samples more than 6 sigma from what the others of their pixel say (cosmic hits, blinking pixels); both need
    3 samples to judge by. These figures are those of the default ``rules``.

    Args:
        frames: codes in DN.
        exposures_s: of the frames.
        noise: of the sensor.
        rules: see ``HdrRules``.

    Raises:
        FitError: when exposures are not positive, or not as many as frames.
    """
    rules = rules or HdrRules()
    times = np.asarray(exposures_s, dtype=np.float64)
    if len(frames) != len(times) or not len(times) or not np.all((times > 0) & np.isfinite(times)):
        raise FitError(
            f"Expected a positive exposure for each of the {len(frames)} frames of a bracket, found {times.tolist()}. "
            "Give the exposures in seconds."
        )
    # Times in units of the longest: sums of their squares stay in single precision's range.
    unit = float(times.max())
    sensor = _sensor_numbers(noise, unit, rules)
    flat = np.ascontiguousarray(frames).reshape(len(frames), -1)
    scaled = (times / unit).astype(np.float32)
    keep = np.arange(len(frames))
    merged = _merge(flat, scaled, sensor, rules)
    dropped: list[str] = []
    while (bad := _frame_off(flat[keep], scaled[keep], sensor, rules, merged)) is not None:
        dropped.append(f"frame {keep[bad]}")
        keep = np.delete(keep, bad)
        merged = _merge(flat[keep], scaled[keep], sensor, rules)
    hits = _mend_hits(flat[keep], scaled[keep], sensor, rules, merged)
    # In place: copies of a full frame would cost as much as a third of the merging.
    for values in (merged.rate, merged.sigma):
        values /= np.float32(unit)
    unknown, notes = merged.used <= 0, ()
    if unknown.any():
        merged.rate[unknown], merged.sigma[unknown] = 0.0, UNKNOWN_SIGMA
        notes = (f"{np.count_nonzero(unknown)} of {unknown.size} pixels have no sample that could be used.",)
    shape = frames.shape[1:]
    off = f"{100 * rules.frame_off:g} % and {rules.frame_sigma:g} sigma"
    hit = f"more than {rules.believed_sigma:g} sigma from what its other samples say; that sample is left out"
    places = (str(tuple(int(k) for k in np.unravel_index(pixel, shape))) for pixel in hits)
    return HdrMerge(
        merged.rate.reshape(shape),
        merged.sigma.reshape(shape),
        merged.used.reshape(shape),
        outliers(f"frames whose light is off by more than {off}", dropped)
        + outliers(f"pixels with a sample {hit}", places),
        FitStatus.SATURATED if unknown.size and unknown.all() else FitStatus.CONVERGED,
        notes,
    )


def _sensor_numbers(noise: Noise, unit_s: float, rules: HdrRules) -> SensorNumbers:
    K, black = float(np.asarray(noise.K_DN_per_e)), float(np.asarray(noise.black_DN))
    floor = float(np.asarray(noise.sigma_d_e)) ** 2 + (float(np.asarray(noise.q_DN)) / K) ** 2 / 12.0
    # A sensor without any dark noise still has a least variance: the likelihood of its dark pixels stays finite.
    floor = max(floor, 1e-4)
    level = (float(np.asarray(noise.saturation_DN)) - black) / K - rules.margin_sigma * math.sqrt(floor)
    numbers = (black, 1 / K, float(np.asarray(noise.dark_current_e_per_s)) * unit_s, floor, level)
    return SensorNumbers(*(np.float32(n) for n in numbers))


def _merge(
    flat: UInt16[np.ndarray, "n pixels"],
    times: Float[np.ndarray, " n"],
    sensor: SensorNumbers,
    rules: HdrRules,
    left_out: Bool[np.ndarray, "n pixels"] | None = None,
) -> BlockMerge:
    """In blocks of one size, on two threads; the last block overlaps the one before it."""
    pixels = flat.shape[1]
    size = next((b for b in _BLOCKS if b <= pixels), _BLOCKS[-1])
    short = size - pixels
    if short > 0:
        flat = np.pad(flat, ((0, 0), (0, short)))
        left_out = None if left_out is None else np.pad(left_out, ((0, 0), (0, short)))
    out = BlockMerge(
        *(np.empty(flat.shape[1], dtype) for dtype in (np.float32, np.float32, *[np.int32] * 2, np.float32))
    )

    def run(start: int) -> None:
        part = np.s_[start : start + size]
        block = merge_block(flat[:, part], times, sensor, None if left_out is None else left_out[:, part], rules)
        _into(out, part, block)

    starts = [min(s, flat.shape[1] - size) for s in range(0, flat.shape[1], size)]
    with ThreadPoolExecutor(_THREADS) as pool:
        list(pool.map(run, starts))
    return BlockMerge(*(part[:pixels] for part in jax.tree.leaves(out)))


def _into(out: BlockMerge, where: slice | Int[np.ndarray, " some"], part: BlockMerge) -> None:
    for into, values in zip(jax.tree.leaves(out), jax.tree.leaves(part), strict=True):
        into[where] = values


def _frame_off(
    flat: UInt16[np.ndarray, "n pixels"],
    times: Float[np.ndarray, " n"],
    sensor: SensorNumbers,
    rules: HdrRules,
    merged: BlockMerge,
) -> int | None:
    """The frame whose light differs most from the others', when that is too much."""
    if len(times) < rules.least_to_judge:
        return None
    lit = np.flatnonzero((merged.used >= rules.least_to_judge) & (merged.rate > 0))
    lit = lit[:: max(1, len(lit) // rules.frame_pixels)]
    light = (flat[:, lit].astype(np.float64) - float(sensor.black_DN)) * float(sensor.e_per_DN)
    signal = merged.rate[lit].astype(np.float64) * times[:, None]
    dark = float(sensor.dark_e_per_s) * times[:, None]
    variance = signal + dark + float(sensor.floor_e2)
    # The open samples near the level are the low ones of their kind: stay clear of them.
    clear = signal + dark + 5 * np.sqrt(variance) < float(sensor.level_e)
    score = [
        _off_in_sigma((x - d)[c] / s[c] - 1, (np.sqrt(v) / s)[c], rules)
        for x, d, s, v, c in zip(light, dark, signal, variance, clear, strict=True)
    ]
    worst = int(np.argmax(score))
    return worst if score[worst] > rules.frame_sigma else None


def _off_in_sigma(
    relative: Float[np.ndarray, " pixels"], sigma: Float[np.ndarray, " pixels"], rules: HdrRules
) -> float:
    """How many sigma the median of one frame's relative deviations is from 0; 0 where it is too small to matter.

    A median of clear signals: hits do not count as a lamp that flickers, nor the skew of a few electrons.
    """
    clear = sigma < 1 / rules.frame_snr
    if np.count_nonzero(clear) < rules.frame_least_pixels:
        return 0.0
    off = abs(float(np.median(relative[clear])))
    # A median's standard error is 1.2533 times a mean's.
    error = 1.2533 * float(np.median(sigma[clear])) / math.sqrt(np.count_nonzero(clear))
    return off / error if off > rules.frame_off else 0.0


def _mend_hits(
    flat: UInt16[np.ndarray, "n pixels"],
    times: Float[np.ndarray, " n"],
    sensor: SensorNumbers,
    rules: HdrRules,
    merged: BlockMerge,
) -> Int[np.ndarray, " hits"]:
    """Leave out the worst sample of a pixel while it is too far off; changes ``merged``, returns the pixels mended."""
    touched: list[np.ndarray] = []
    suspects = np.flatnonzero((merged.deviation2 > rules.believed_sigma**2) & (len(times) >= rules.least_to_judge))
    left_out = np.zeros((len(times), len(suspects)), dtype=bool)
    while len(suspects):
        left_out[merged.worst[suspects], np.arange(len(suspects))] = True
        again = _merge(np.ascontiguousarray(flat[:, suspects]), times, sensor, rules, left_out)
        _into(merged, suspects, again)
        touched.append(suspects)
        more = (again.deviation2 > rules.believed_sigma**2) & (
            len(times) - left_out.sum(axis=0) >= rules.least_to_judge
        )
        suspects, left_out = suspects[more], np.ascontiguousarray(left_out[:, more])
    return np.unique(np.concatenate(touched)) if touched else np.zeros(0, dtype=np.int64)
