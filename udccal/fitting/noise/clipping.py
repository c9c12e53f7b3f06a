"""Clipping in flats: bins in which every pixel is full, and the level at which the samples of uneven flats end."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from udccal.fitting.noise.dark import DarkTerms
from udccal.fitting.noise.moments import Moments, NoiseMoments

Bins = Bool[np.ndarray, "flats bins"]


def stacked(flats: tuple[Moments, ...], name: str) -> Float[np.ndarray, "levels bins"]:
    """The field ``name`` of every flat and bin."""
    return np.stack([getattr(flat, name) for flat in flats])


def full_bins(data: NoiseMoments, dark: DarkTerms) -> Bins:
    """Return the saturated bins: as bright as any, with far less variance than the rest predicts for their mean.

    Where all flats are saturated there is no rest: bins with no more variance than the dark frames are then saturated.
    """
    mean, variance = stacked(data.flats, "mean_DN") - dark.black_DN, stacked(data.flats, "variance_DN2")
    bright: Bins = mean > 0.05 * (data.top_DN - dark.black_DN)
    if not bright.any():
        return bright
    # Saturation is a ceiling: a quiet bin well below the brightest one is something else.
    highest = bright & (mean >= 0.9 * mean.max())
    # Below saturation variance over mean is K plus a small positive part; clipping only lowers it.
    slope = variance / np.maximum(mean, 1e-9)
    collapsed: Bins = highest & (slope < 0.3 * float(np.quantile(slope[bright], 0.75)))
    quiet: Bins = highest & (variance <= 1.3 * (dark.read_DN2.value + data.rounding_DN2 + dark.row_DN2.value))
    return quiet if not collapsed.any() and quiet[bright].mean() > 0.5 else collapsed


def piled_up(data: NoiseMoments, dark: DarkTerms) -> tuple[float, float] | None:
    """Return level and sigma in DN where full pixels of uneven flats pile up, or None.

    Flats that are dimmer towards the corners clip in their middle alone: no bin is full. The full pixels have the dark
    noise about one level, nothing is brighter, and shot noise has spread all others over far more codes.
    """
    q, spread2 = data.q_DN, dark.read_DN2.value + dark.dsnu_DN2.value + dark.row_DN2.value + data.rounding_DN2
    half = max(int(np.ceil(2.5 * np.sqrt(spread2) / q)), 1)
    found = [pile for flat in data.flats if (pile := _pile(flat.codes[::q], half))]
    if not found:
        return None
    middle, count, floor = max(found, key=lambda pile: pile[1])
    level = middle * q
    # The light of unclipped pixels shifts the mean by at most this.
    shift = floor / count * half * q
    shot2 = dark.K_DN_per_e * (level - dark.black_DN)
    if shot2 < 9.0 * spread2 or level + 3.0 * np.sqrt(spread2) >= data.top_DN:
        return None
    return level, float(np.sqrt(spread2 / count + shift**2))


def _pile(codes: Int[np.ndarray, " codes"], half: int) -> tuple[float, int, int] | None:
    """Return the mean code of a pile at the upper end of a histogram, its samples, and those as far again below it."""
    below = np.concatenate([np.zeros(3 * half + 2, np.int64), np.cumsum(codes), np.full(half, codes.sum())])
    width, end = 2 * half + 1, len(codes)
    # At code c the pile has codes c - half to c + half.
    up_to, down_to, before = below[width + 2 * half + 1 :][:end], below[2 * half + 1 :][:end], below[:end]
    inside, floor, above = up_to - down_to, down_to - before, codes.sum() - up_to
    piles = (inside >= max(100, 1e-3 * codes.sum())) & (inside >= 5 * floor) & (above <= 0.02 * inside)
    if not piles.any():
        return None
    at = int(np.argmax(np.where(piles, inside, 0)))
    near = np.arange(max(at - half, 0), min(at + half + 1, end))
    return float(np.average(near, weights=codes[near])), int(inside[at]), int(floor[at])
