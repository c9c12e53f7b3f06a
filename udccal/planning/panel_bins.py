"""What shots of the panel tell of every bin, with its mask m and dark signal d estimated along, and of the kernel x.

A bin sees white as m + d, a picture as m r(x) + d and the dark frame as d. d, then m, are taken out of the information
on x by Schur's complement, bin by bin.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float

from udccal.fitting.engine.gaussian import scaled_inverse


@final
@dataclass(frozen=True)
class Ratios:
    """Light of pictures over that of white, and its slopes by the kernel's parameters."""

    value: Float[np.ndarray, "pictures 3 n"]
    slope: Float[np.ndarray, "pictures 3 n 18"]

    def part(self, which: slice) -> Ratios:
        """Some of the pictures."""
        return Ratios(self.value[which], self.slope[which])


@final
@dataclass(frozen=True)
class BinNoise:
    """Variance of a bin per unit of its light, in the dark, and of the dark frame; ``mask`` is the light of white.

    ``share`` of the mask is what a model leaves undescribed of any picture but white.
    """

    mask: Float[np.ndarray, "3 n"]
    shot: Float[np.ndarray, "3 n"]
    rest: Float[np.ndarray, "3 n"]
    dark: Float[np.ndarray, "3 n"]
    share: float


@final
@dataclass(frozen=True)
class Told:
    """Information on the kernel, on each bin's mask where the dark is not known, and how that follows the kernel."""

    kernel: Float[np.ndarray, "18 18"]
    mask: Float[np.ndarray, "3 n"]
    following: Float[np.ndarray, "3 n 18"]


def told_by(ratios: Ratios, noise: BinNoise, count: float) -> Told:
    """What ``count`` pictures tell of which ``ratios`` are a sample, with white and dark."""
    light = noise.shot * noise.mask * ratios.value
    weight = count / len(ratios.value) / (light + noise.rest + (noise.share * noise.mask) ** 2)
    white = 1 / (noise.shot * noise.mask + noise.rest)
    # White and dark have no slope by the kernel.
    way = noise.mask[..., None] * ratios.slope
    by_mask = np.einsum("icn,icnk,icn->cnk", weight, way, ratios.value)
    by_dark = np.einsum("icn,icnk->cnk", weight, way)
    both, dark = (weight * ratios.value).sum(axis=0) + white, weight.sum(axis=0) + white + 1 / noise.dark
    mask = (weight * ratios.value**2).sum(axis=0) + white - both**2 / dark
    following = by_mask - by_dark * (both / dark)[..., None]
    kernel = np.einsum("icn,icnk,icnl->kl", weight, way, way, optimize=True)
    kernel -= np.einsum("cnk,cnl,cn->kl", by_dark, by_dark, 1 / dark, optimize=True)
    kernel -= np.einsum("cnk,cnl,cn->kl", following, following, 1 / mask, optimize=True)
    return Told(kernel, mask, following / mask[..., None])


def light_sigma(new: Ratios, noise: BinNoise, told: Told, prior: Float[np.ndarray, "18 18"], inflation: float) -> float:
    """Root mean square over bins, colours and new pictures, relative to that of the pictures' peaks.

    Args:
        new: of pictures that were not shown.
        noise: gives the mask, and what the model leaves out of the new pictures.
        told: by those that were shown.
        prior: information on the kernel from before.
        inflation: of its variances.
    """
    cov = scaled_inverse(told.kernel + prior) * inflation
    slope = noise.mask[..., None] * new.slope - new.value[..., None] * told.following
    variance = np.einsum("icnk,kl,icnl->icn", slope, cov, slope, optimize=True) + new.value**2 / told.mask
    peak = (noise.mask * new.value).max(axis=(1, 2))
    whole = float((variance + (noise.share * noise.mask) ** 2).mean())
    return float(np.sqrt(whole / (peak**2).mean()))
