"""Mask and dark signal of every bin at their best: they stand in no prior and enter linearly, so they go exactly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from udccal.fitting.backscatter.evidence import Evidence


@dataclass(frozen=True)
class Profiled:
    """Mask and dark signal for given ratios, with the mask's information where the dark is not known."""

    mask: Float[np.ndarray, "3 n"]
    dark: Float[np.ndarray, "3 n"]
    information: Float[np.ndarray, "3 n"]


def with_white(pictures: Float[np.ndarray, "*k pictures 3 n"]) -> Float[np.ndarray, "*k shots 3 n"]:
    """Ratios of all shots, white first: it is what the others are compared with."""
    white = np.ones((*pictures.shape[:-3], 1, *pictures.shape[-2:]))
    return np.concatenate([white, pictures], axis=-3)


def with_still_white(slopes: Float[np.ndarray, "k pictures 3 n"]) -> Float[np.ndarray, "k shots 3 n"]:
    """Slopes of the ratios of all shots: white's stays 1, whatever moves."""
    still = np.zeros((len(slopes), 1, *slopes.shape[2:]))
    return np.concatenate([still, slopes], axis=1)


def profiled(ratio: Float[np.ndarray, "shots 3 n"], seen: Evidence, weight: Float[np.ndarray, "shots 3 n"]) -> Profiled:
    """Mask and dark signal by weighted linear least squares, bin by bin."""
    square, apart, sure = weight**2, seen.exposure[:, None, None], 1 / seen.dark_variance
    own, cross = (square * ratio**2).sum(0), (square * ratio * apart).sum(0)
    rest = (square * apart**2).sum(0) + sure
    light = square * seen.light
    by_ratio, by_dark = (light * ratio).sum(0), (light * apart).sum(0) + sure * seen.dark
    information = own - cross**2 / rest
    known = information > 0
    mask = np.where(known, (by_ratio - cross * by_dark / rest) / np.where(known, information, 1.0), 0.0)
    return Profiled(mask, (by_dark - cross * mask) / rest, information)


def mask_slopes(
    ratio: Float[np.ndarray, "shots 3 n"],
    slope: Float[np.ndarray, "k shots 3 n"],
    best: Profiled,
    seen: Evidence,
    weight: Float[np.ndarray, "shots 3 n"],
) -> Float[np.ndarray, "k 3 n"]:
    """How the best mask follows the ratios, for the light that is expected; what noise adds is of second order."""
    square, apart, sure = weight**2, seen.exposure[:, None, None], 1 / seen.dark_variance
    cross, rest = (square * ratio * apart).sum(0), (square * apart**2).sum(0) + sure
    along = (square * (ratio - apart * cross / rest) * slope).sum(axis=1)
    known = best.information > 0
    return np.asarray(np.where(known, -best.mask * along / np.where(known, best.information, 1.0), 0.0))


def predicted_variance(
    ratio: Float[np.ndarray, "pictures 3 n"],
    slope: Float[np.ndarray, "k pictures 3 n"],
    best: Profiled,
    by_mask: Float[np.ndarray, "k 3 n"],
    cov: Float[np.ndarray, "k k"],
) -> Float[np.ndarray, "pictures 3 n"]:
    """Of the light of pictures: the parameters' covariance, the mask's noise, and how the two hang together.

    Args:
        ratio, slope: of the pictures' light over that of white, and by the parameters.
        best: the mask.
        by_mask: how it follows the parameters, of ``mask_slopes``.
        cov: of the parameters.
    """
    moves = best.mask * slope + ratio * by_mask[:, None]
    variance = np.einsum("kicn,kl,licn->icn", moves, cov, moves, optimize=True)
    return np.asarray(variance + ratio**2 / np.maximum(best.information, 1e-30))


def whitened(
    ratio: Float[np.ndarray, "shots 3 n"],
    slope: Float[np.ndarray, "k shots 3 n"],
    seen: Evidence,
    weight: Float[np.ndarray, "shots 3 n"],
) -> tuple[Float[np.ndarray, "shots_1 3 n"], Float[np.ndarray, "k shots_1 3 n"]]:
    """Errors of shots and dark in units of their sigma, and their slopes, off what mask and dark can take up.

    With m and d held at their best, the slope by the ratios alone is projected; the errors are at right angles to m
    and d already (Kaufman, BIT 15, 1975). J^T J is then the information of the profiled likelihood.
    """
    best = profiled(ratio, seen, weight)
    apart, sure = seen.exposure[:, None, None], 1 / np.sqrt(seen.dark_variance)
    bright = (seen.light - best.mask * ratio - apart * best.dark) * weight
    errors = np.concatenate([bright, ((seen.dark - best.dark) * sure)[None]])
    nothing = np.zeros_like(sure)[None]
    dark_way = _unit(np.concatenate([apart * weight, sure[None]]))
    mask_way = np.concatenate([ratio * weight, nothing])
    mask_way = _unit(mask_way - dark_way * (dark_way * mask_way).sum(0))
    by_ratio = np.concatenate([-(best.mask * weight) * slope, np.zeros((len(slope), *nothing.shape))], axis=1)
    for way in (dark_way, mask_way):
        by_ratio -= way * np.einsum("scn,kscn->kcn", way, by_ratio)[:, None]
    return errors, by_ratio


def _unit(vectors: Float[np.ndarray, "shots_1 3 n"]) -> Float[np.ndarray, "shots_1 3 n"]:
    square = (vectors**2).sum(0)
    return np.asarray(vectors / np.sqrt(np.where(square > 0, square, 1.0)))
