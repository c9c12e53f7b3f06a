"""Exposure brackets to one linear picture: maximum likelihood with the sensor's noise model."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt16

from udccal.errors import FitError
from udccal.fitting.hdr.likelihood import BELIEVED_SIGMA, SensorNumbers, merge_block
from udccal.models.noise import Noise
from udccal.result import Outliers

# What sigma says where no sample could be used: larger than any rate a sensor can tell, and finite.
UNKNOWN_SIGMA = 1e12
# A full well holds its charge before the dark noise is added: this many sigma below, no sample is a full one.
_MARGIN_SIGMA = 6.0
# Pixels of one compiled pass: large pictures, and crops.
_BLOCKS = (1 << 16, 1 << 12)
_THREADS = 2
# A frame whose light is off by more than this, and by more than 5 sigma, is left out.
_FRAME_OFF, _FRAME_SIGMA = 0.02, 5.0
_FRAME_PIXELS, _FRAME_LEAST_PIXELS, _FRAME_SIGNAL_TO_NOISE = 20_000, 8, 10.0
_LEAST_TO_JUDGE = 3
_PLACES = 8


@dataclass(frozen=True)
class HdrMerge:
    """Rate in e-/s with one standard deviation, and how many samples each pixel rests on (0: none, rate 0)."""

    rate_e_per_s: Float[np.ndarray, "*picture"]
    sigma_e_per_s: Float[np.ndarray, "*picture"]
    used: Int[np.ndarray, "*picture"]
    outliers: tuple[Outliers, ...] = ()


def merge_bracket(
    frames: UInt16[np.ndarray, "n *picture"], exposures_s: Float[np.ndarray, " exposures"], noise: Noise
) -> HdrMerge:
    """Merge frames of one still scene at several exposures (repeats allowed).

    Solves the likelihood equation of ``hdr.likelihood`` for each pixel: shot, dark and quantisation noise at the
    merged rate (weights from single noisy samples would pull dark pixels down), samples within 6 sigma of saturation
    as censored. In single precision, which moves no rate by a thousandth of its sigma; compiled once per number
    of frames.

    Left out and listed are frames whose light is off by more than 2 % (a lamp that flickered, a dropped frame), and
    single samples more than 6 sigma from what the others of their pixel say (cosmic hits, blinking pixels); both need
    3 samples to judge by.

    Raises:
        FitError: when exposures are not positive, or not as many as frames.
    """
    times = np.asarray(exposures_s, dtype=np.float64)
    if len(frames) != len(times) or not len(times) or not np.all((times > 0) & np.isfinite(times)):
        raise FitError(
            f"Expected a positive exposure for each of the {len(frames)} frames of a bracket, found {times.tolist()}. "
            "Give the exposures in seconds."
        )
    # Times in units of the longest: sums of their squares stay in single precision's range.
    unit = float(times.max())
    sensor = _sensor_numbers(noise, unit)
    flat = np.ascontiguousarray(frames).reshape(len(frames), -1)
    scaled = (times / unit).astype(np.float32)
    keep = np.arange(len(frames))
    merged = _merge(flat, scaled, sensor)
    dropped: list[str] = []
    while (bad := _frame_off(flat[keep], scaled[keep], sensor, merged)) is not None:
        dropped.append(f"frame {keep[bad]}")
        keep = np.delete(keep, bad)
        merged = _merge(flat[keep], scaled[keep], sensor)
    hits = _mend_hits(flat[keep], scaled[keep], sensor, merged)
    # In place: copies of a full frame would cost as much as a third of the merging.
    for values in (merged.rate, merged.sigma):
        values /= np.float32(unit)
    unknown = merged.used <= 0
    if unknown.any():
        merged.rate[unknown], merged.sigma[unknown] = 0.0, UNKNOWN_SIGMA
    shape = frames.shape[1:]
    return HdrMerge(
        merged.rate.reshape(shape),
        merged.sigma.reshape(shape),
        merged.used.reshape(shape),
        _listed(dropped, hits, shape),
    )


@dataclass(frozen=True)
class _Merged:
    """A ``BlockMerge`` of the whole picture, in numpy."""

    rate: Float[np.ndarray, " pixels"]
    sigma: Float[np.ndarray, " pixels"]
    used: Int[np.ndarray, " pixels"]
    worst: Int[np.ndarray, " pixels"]
    deviation2: Float[np.ndarray, " pixels"]


def _sensor_numbers(noise: Noise, unit_s: float) -> SensorNumbers:
    K, black = float(np.asarray(noise.K_DN_per_e)), float(np.asarray(noise.black_DN))
    floor = float(np.asarray(noise.sigma_d_e)) ** 2 + (float(np.asarray(noise.q_DN)) / K) ** 2 / 12.0
    # A sensor without any dark noise still has a least variance: the likelihood of its dark pixels stays finite.
    floor = max(floor, 1e-4)
    level = (float(np.asarray(noise.saturation_DN)) - black) / K - _MARGIN_SIGMA * math.sqrt(floor)
    numbers = (black, 1 / K, float(np.asarray(noise.dark_current_e_per_s)) * unit_s, floor, level)
    return SensorNumbers(*(np.float32(n) for n in numbers))


def _merge(
    flat: UInt16[np.ndarray, "n pixels"],
    times: Float[np.ndarray, " n"],
    sensor: SensorNumbers,
    left_out: Bool[np.ndarray, "n pixels"] | None = None,
) -> _Merged:
    """In blocks of one size, on two threads; the last block overlaps the one before it."""
    pixels = flat.shape[1]
    size = next((b for b in _BLOCKS if b <= pixels), _BLOCKS[-1])
    short = size - pixels
    if short > 0:
        flat = np.pad(flat, ((0, 0), (0, short)))
        left_out = None if left_out is None else np.pad(left_out, ((0, 0), (0, short)))
    out = _Merged(*(np.empty(flat.shape[1], dtype) for dtype in (np.float32, np.float32, *[np.int32] * 2, np.float32)))

    def run(start: int) -> None:
        part = np.s_[start : start + size]
        block = merge_block(flat[:, part], times, sensor, None if left_out is None else left_out[:, part])
        for name in ("rate", "sigma", "used", "worst", "deviation2"):
            getattr(out, name)[part] = getattr(block, name)

    starts = [min(s, flat.shape[1] - size) for s in range(0, flat.shape[1], size)]
    with ThreadPoolExecutor(_THREADS) as pool:
        list(pool.map(run, starts))
    return _Merged(
        out.rate[:pixels], out.sigma[:pixels], out.used[:pixels], out.worst[:pixels], out.deviation2[:pixels]
    )


def _frame_off(
    flat: UInt16[np.ndarray, "n pixels"], times: Float[np.ndarray, " n"], sensor: SensorNumbers, merged: _Merged
) -> int | None:
    """The frame whose light differs most from the others', when that is too much."""
    if len(times) < _LEAST_TO_JUDGE:
        return None
    lit = np.flatnonzero((merged.used >= _LEAST_TO_JUDGE) & (merged.rate > 0))
    lit = lit[:: max(1, len(lit) // _FRAME_PIXELS)]
    light = (flat[:, lit].astype(np.float64) - float(sensor.black_DN)) * float(sensor.e_per_DN)
    signal = merged.rate[lit].astype(np.float64) * times[:, None]
    dark = float(sensor.dark_e_per_s) * times[:, None]
    variance = signal + dark + float(sensor.floor_e2)
    # The open samples near the level are the low ones of their kind: stay clear of them.
    clear = signal + dark + 5 * np.sqrt(variance) < float(sensor.level_e)
    score = [
        _off_in_sigma((x - d)[c] / s[c] - 1, (np.sqrt(v) / s)[c])
        for x, d, s, v, c in zip(light, dark, signal, variance, clear, strict=True)
    ]
    worst = int(np.argmax(score))
    return worst if score[worst] > _FRAME_SIGMA else None


def _off_in_sigma(relative: Float[np.ndarray, " pixels"], sigma: Float[np.ndarray, " pixels"]) -> float:
    """How many sigma the median of one frame's relative deviations is from 0; 0 where it is too small to matter.

    A median of clear signals: hits do not count as a lamp that flickers, nor the skew of a few electrons.
    """
    clear = sigma < 1 / _FRAME_SIGNAL_TO_NOISE
    if np.count_nonzero(clear) < _FRAME_LEAST_PIXELS:
        return 0.0
    off = abs(float(np.median(relative[clear])))
    # A median's standard error is 1.2533 times a mean's.
    error = 1.2533 * float(np.median(sigma[clear])) / math.sqrt(np.count_nonzero(clear))
    return off / error if off > _FRAME_OFF else 0.0


def _mend_hits(
    flat: UInt16[np.ndarray, "n pixels"], times: Float[np.ndarray, " n"], sensor: SensorNumbers, merged: _Merged
) -> Int[np.ndarray, " hits"]:
    """Leave out the worst sample of a pixel while it is too far off; changes ``merged``, returns the pixels mended."""
    touched: list[np.ndarray] = []
    suspects = np.flatnonzero((merged.deviation2 > BELIEVED_SIGMA**2) & (len(times) >= _LEAST_TO_JUDGE))
    left_out = np.zeros((len(times), len(suspects)), dtype=bool)
    while len(suspects):
        left_out[merged.worst[suspects], np.arange(len(suspects))] = True
        again = _merge(np.ascontiguousarray(flat[:, suspects]), times, sensor, left_out)
        for name in ("rate", "sigma", "used", "worst", "deviation2"):
            getattr(merged, name)[suspects] = getattr(again, name)
        touched.append(suspects)
        more = (again.deviation2 > BELIEVED_SIGMA**2) & (len(times) - left_out.sum(axis=0) >= _LEAST_TO_JUDGE)
        suspects, left_out = suspects[more], np.ascontiguousarray(left_out[:, more])
    return np.unique(np.concatenate(touched)) if touched else np.zeros(0, dtype=np.int64)


def _listed(dropped: list[str], hits: Int[np.ndarray, " hits"], shape: tuple[int, ...]) -> tuple[Outliers, ...]:
    listed = []
    if dropped:
        listed.append(Outliers("frames whose light is off by more than 2 % and 5 sigma", len(dropped), tuple(dropped)))
    if len(hits):
        places = tuple(str(tuple(int(k) for k in np.unravel_index(pixel, shape))) for pixel in hits[:_PLACES])
        rule = "pixels with a sample more than 6 sigma from what its other samples say; that sample is left out"
        listed.append(Outliers(rule, len(hits), places))
    return tuple(listed)
