"""Exposure brackets to one linear picture: maximum likelihood with the sensor's noise model."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import final

import jax
import numpy as np
from jaxtyping import Bool, Float, Int, UInt16

from udccal.errors import FitError
from udccal.fitting.engine.robust import outliers
from udccal.fitting.hdr.likelihood import BlockMerge, SensorNumbers, merge_block
from udccal.models.noise import Noise
from udccal.result import FitStatus, Outliers

# Sigma where no sample could be used: finite, and larger than any rate that a sensor can measure.
UNKNOWN_SIGMA = 1e12
_BLOCKS = (1 << 16, 1 << 12)  # pixels of one compiled pass: large pictures, and crops


@final
@dataclass(frozen=True)
class HdrRules:
    """The constants of a merge.

    Attributes:
        believed_sigma: a sample farther than this from the other samples of its pixel is a hit, clipped or not.
        margin_sigma: samples count as clipped from this many sigma of dark noise below saturation on.
        frame_off, frame_sigma: a frame is left out when its light is off by more than both (relative, and in sigma).
        frame_pixels: the most pixels by which a frame is tested.
        frame_least_pixels, frame_snr: the fewest pixels for that test, and the least signal over noise of each.
        least_to_judge: the fewest samples of a pixel for finding hits and testing frames.
    """

    believed_sigma: float = 6.0
    margin_sigma: float = 6.0
    frame_off: float = 0.02
    frame_sigma: float = 5.0
    frame_pixels: int = 20_000
    frame_least_pixels: int = 8
    frame_snr: float = 10.0
    least_to_judge: int = 3


@final
@dataclass(frozen=True)
class HdrMerge:
    """A picture of one still scene, from a bracket.

    Attributes:
        rate_e_per_s, sigma_e_per_s: light of every pixel, with one standard deviation.
        used: number of samples used for each pixel; where it is 0 the rate is 0 and sigma ``UNKNOWN_SIGMA``.
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

    It solves the likelihood equation of ``hdr.likelihood`` for each pixel. Shot, dark and quantisation noise are those
    at the merged rate: weights from single noisy samples would pull dark pixels down. Samples within 6 sigma of
    saturation are censored. Single precision moves no rate by a thousandth of its sigma.

    Two kinds of outliers are left out and listed: frames whose light is off by more than 2 % (a lamp that flickered, a
    dropped frame), and samples more than 6 sigma from the other samples of their pixel (cosmic hits, blinking pixels).
    Both tests need 3 samples of a pixel. These figures are those of the default ``rules``.

    Args:
        frames: codes in DN, one frame or mosaic per exposure, all of one shape.
        exposures_s: exposure of each frame.
        noise: noise model of the sensor.
        rules: see ``HdrRules``.

    Returns:
        rate and sigma in e-/s of every pixel, and the outliers; status ``SATURATED`` where no sample could be used.

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
    unit, shape, kept = float(times.max()), frames.shape[1:], np.arange(len(frames))
    codes = np.ascontiguousarray(frames).reshape(len(frames), -1)
    bracket = _Bracket(codes, (times / unit).astype(np.float32), sensor_numbers(noise, unit, rules), rules)
    merged = bracket.merged()
    while (bad := bracket.frame_off(merged)) is not None:
        kept = np.delete(kept, bad)
        bracket = replace(bracket, codes=np.delete(bracket.codes, bad, 0), times=np.delete(bracket.times, bad))
        merged = bracket.merged()
    hits = bracket.mend_hits(merged)
    # In place: copies of a full frame would cost as much as a third of the merging.
    for values in (merged.rate, merged.sigma):
        values /= np.float32(unit)
    unknown = merged.used <= 0
    merged.rate[unknown], merged.sigma[unknown] = 0.0, UNKNOWN_SIGMA
    note = f"{np.count_nonzero(unknown)} of {unknown.size} pixels have no sample that could be used."
    off = f"frames whose light is off by more than {100 * rules.frame_off:g} % and {rules.frame_sigma:g} sigma"
    hit = f"pixels with a sample more than {rules.believed_sigma:g} sigma from what its other samples say; that sample"
    dropped = (f"frame {i}" for i in np.setdiff1d(np.arange(len(frames)), kept))
    places = (str(tuple(int(k) for k in np.unravel_index(pixel, shape))) for pixel in hits)
    return HdrMerge(
        merged.rate.reshape(shape),
        merged.sigma.reshape(shape),
        merged.used.reshape(shape),
        outliers(off, dropped) + outliers(f"{hit} is left out", places),
        FitStatus.SATURATED if unknown.size and unknown.all() else FitStatus.CONVERGED,
        (note,) if unknown.any() else (),
    )


def sensor_numbers(noise: Noise, unit_s: float, rules: HdrRules) -> SensorNumbers:
    """The numbers of a noise model that the likelihood uses, times in units of ``unit_s``."""
    K, black = float(np.asarray(noise.K_DN_per_e)), float(np.asarray(noise.black_DN))
    floor = float(np.asarray(noise.sigma_d_e)) ** 2 + (float(np.asarray(noise.q_DN)) / K) ** 2 / 12.0
    # A sensor without any dark noise still has a least variance: the likelihood of its dark pixels stays finite.
    floor = max(floor, 1e-4)
    level = (float(np.asarray(noise.saturation_DN)) - black) / K - rules.margin_sigma * math.sqrt(floor)
    numbers = (black, 1 / K, float(np.asarray(noise.dark_current_e_per_s)) * unit_s, floor, level)
    return SensorNumbers(*(np.float32(n) for n in numbers))


@dataclass(frozen=True)
class _Bracket:
    codes: UInt16[np.ndarray, "n pixels"]
    times: Float[np.ndarray, " n"]
    sensor: SensorNumbers
    rules: HdrRules

    def merged(self, left_out: Bool[np.ndarray, "n pixels"] | None = None) -> BlockMerge:
        """Merge in blocks of one size on two threads, to numpy; the last block overlaps the one before it."""
        codes, pixels = self.codes, self.codes.shape[1]
        size = next((b for b in _BLOCKS if b <= pixels), _BLOCKS[-1])
        if (short := size - pixels) > 0:
            codes = np.pad(codes, ((0, 0), (0, short)))
            left_out = None if left_out is None else np.pad(left_out, ((0, 0), (0, short)))
        kinds = (np.float32, np.float32, np.int32, np.int32, np.float32)
        out = BlockMerge(*(np.empty(codes.shape[1], kind) for kind in kinds))

        def run(start: int) -> None:
            part = np.s_[start : start + size]
            own = None if left_out is None else left_out[:, part]
            _put(out, part, merge_block(codes[:, part], self.times, self.sensor, own, self.rules.believed_sigma))

        with ThreadPoolExecutor(2) as pool:
            list(pool.map(run, [min(s, codes.shape[1] - size) for s in range(0, codes.shape[1], size)]))
        return BlockMerge(*(part[:pixels] for part in jax.tree.leaves(out)))

    def frame_off(self, merged: BlockMerge) -> int | None:
        """The frame whose light differs most from the others', when that is too much."""
        rules, sensor = self.rules, self.sensor
        if len(self.times) < rules.least_to_judge:
            return None
        lit = np.flatnonzero((merged.used >= rules.least_to_judge) & (merged.rate > 0))
        lit = lit[:: max(1, len(lit) // rules.frame_pixels)]
        light = (self.codes[:, lit].astype(np.float64) - float(sensor.black_DN)) * float(sensor.e_per_DN)
        signal = merged.rate[lit].astype(np.float64) * self.times[:, None]
        dark = float(sensor.dark_e_per_s) * self.times[:, None]
        sigma = np.sqrt(signal + dark + float(sensor.floor_e2))
        # Unclipped samples near the level are the low ones of their kind; samples of few electrons are skewed. Both are
        # left out here. The median keeps hits from counting as a lamp that flickers.
        clear = (signal + dark + 5 * sigma < float(sensor.level_e)) & (sigma * rules.frame_snr < signal)
        score = np.zeros(len(clear))
        for i in np.flatnonzero(clear.sum(axis=1) >= rules.frame_least_pixels):
            own = clear[i]
            off = abs(float(np.median((light - dark)[i, own] / signal[i, own] - 1)))
            # A median's standard error is 1.2533 times a mean's.
            error = 1.2533 * float(np.median(sigma[i, own] / signal[i, own])) / math.sqrt(np.count_nonzero(own))
            score[i] = off / error if off > rules.frame_off else 0.0
        worst = int(np.argmax(score))
        return worst if score[worst] > rules.frame_sigma else None

    def mend_hits(self, merged: BlockMerge) -> Int[np.ndarray, " hits"]:
        """Leave out the worst sample of a pixel while it is too far off; changes ``merged``, returns the pixels."""
        limit, least = self.rules.believed_sigma**2, self.rules.least_to_judge
        hits = suspects = np.flatnonzero((merged.deviation2 > limit) & (len(self.times) >= least))
        left_out = np.zeros((len(self.times), len(suspects)), dtype=bool)
        while len(suspects):
            left_out[merged.worst[suspects], np.arange(len(suspects))] = True
            again = replace(self, codes=np.ascontiguousarray(self.codes[:, suspects])).merged(left_out)
            _put(merged, suspects, again)
            more = (again.deviation2 > limit) & (len(self.times) - left_out.sum(axis=0) >= least)
            suspects, left_out = suspects[more], np.ascontiguousarray(left_out[:, more])
        return hits


def _put(out: BlockMerge, where: slice | Int[np.ndarray, " some"], part: BlockMerge) -> None:
    for into, values in zip(jax.tree.leaves(out), jax.tree.leaves(part), strict=True):
        into[where] = values
