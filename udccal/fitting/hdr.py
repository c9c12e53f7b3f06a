"""Exposure brackets to one linear picture: maximum likelihood with the sensor's noise model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt16

from udccal.models.noise import Noise

# What sigma says where no sample could be used: larger than any rate a sensor can tell, and finite.
UNKNOWN_SIGMA = 1e12
# Samples this many sigma from saturation are safe from its bend.
_MARGIN_SIGMA = 4.0
# A sample that holds less than this share of the pixel's information is left out as buried.
_BURIED = 1e-3
_ROUNDS = 5


@dataclass(frozen=True)
class HdrMerge:
    """Rate in e-/s with one standard deviation, and how many samples each pixel rests on (0: none, rate 0)."""

    rate_e_per_s: Float[np.ndarray, "rows columns"]
    sigma_e_per_s: Float[np.ndarray, "rows columns"]
    used: Int[np.ndarray, "rows columns"]


def merge_bracket(
    frames: UInt16[np.ndarray, "n rows columns"], exposures_s: Float[np.ndarray, " n"], noise: Noise
) -> HdrMerge:
    """Merge frames of one still scene at several exposures (repeats allowed).

    Solves the likelihood equation sum t_i (x_i - r t_i) / v_i(r) = 0 for the rate r, where v_i is the noise model's
    variance at the *merged* rate: weights from single noisy samples would pull dark pixels down. The variance is
    continued below zero rate, so that the estimate stays unbiased in the dark. Left out are samples within 4 sigma of
    saturation, judged by the merged rate (by the sample itself only where nothing else is left, and in the first
    round), and buried samples, those with less than 0.1 % of a pixel's information.
    """
    K, black = float(np.asarray(noise.K_DN_per_e)), float(np.asarray(noise.black_DN))
    dark = float(np.asarray(noise.dark_current_e_per_s))
    times = np.asarray(exposures_s, dtype=np.float64)[:, None, None]
    floor = float(np.asarray(noise.sigma_d_e)) ** 2 + (float(np.asarray(noise.q_DN)) / K) ** 2 / 12.0
    full_e = (float(np.asarray(noise.saturation_DN)) - black) / K
    electrons = (frames.astype(np.float64) - black) / K
    limit_e = full_e - _MARGIN_SIGMA * np.sqrt(floor)
    open_samples = electrons < limit_e
    signal = electrons - dark * times
    keep = open_samples
    rate, information = _round(signal, times, keep, np.where(keep, np.maximum(signal, 0.0) + floor, 1.0))
    for _ in range(_ROUNDS):
        expected = (rate + dark) * times
        variance = np.maximum(expected + floor, 0.25 * floor)
        safe = open_samples & (expected < limit_e - _MARGIN_SIGMA * np.sqrt(np.maximum(expected, 0.0)))
        # Where only doubtful samples are left, a slightly bent value is better than none.
        keep = np.where(safe.any(axis=0), safe, open_samples)
        share = np.where(keep, times**2 / variance, 0.0)
        keep = keep & (share >= _BURIED * share.sum(axis=0))
        rate, information = _round(signal, times, keep, variance)
    used = keep.sum(axis=0)
    expected = np.maximum(rate + dark, 0.0) * times + floor
    information = np.where(keep, times**2 / expected, 0.0).sum(axis=0)
    sigma = np.where(used > 0, 1.0 / np.sqrt(np.where(used > 0, information, 1.0)), UNKNOWN_SIGMA)
    return HdrMerge(np.where(used > 0, rate, 0.0), sigma, used.astype(np.int64))


def _round(
    signal: Float[np.ndarray, "n rows columns"],
    times: Float[np.ndarray, "n 1 1"],
    keep: np.ndarray,
    variance: Float[np.ndarray, "n rows columns"],
) -> tuple[Float[np.ndarray, "rows columns"], Float[np.ndarray, "rows columns"]]:
    weight = np.where(keep, times / variance, 0.0)
    information = (weight * times).sum(axis=0)
    return (weight * signal).sum(axis=0) / np.where(information > 0, information, 1.0), information
