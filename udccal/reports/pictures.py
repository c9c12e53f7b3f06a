"""Compares display-encoded pictures with the truth by PSNR and SSIM. Numbers only."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt16

from udccal.cfa import cfa_named
from udccal.restoration.metrics import least_squares_gain, psnr, ssim
from udccal.restoration.tone import display_exposure, encode_srgb


@dataclass(frozen=True)
class Score:
    """Scores of one picture against the truth."""

    psnr_dB: float
    ssim: float


@dataclass(frozen=True)
class PictureComparison:
    """A scene before and after restoration and its truth, all display-encoded (0 to 1), with both scores."""

    name: str
    before: Float[np.ndarray, "rows columns 3"]
    after: Float[np.ndarray, "rows columns 3"]
    truth: Float[np.ndarray, "rows columns 3"]
    score_before: Score
    score_after: Score

    @property
    def gain_dB(self) -> float:
        """PSNR after minus PSNR before."""
        return self.score_after.psnr_dB - self.score_before.psnr_dB


def compare_pictures(
    name: str,
    before: Float[np.ndarray, "rows columns 3"],
    after: Float[np.ndarray, "rows columns 3"],
    truth: Float[np.ndarray, "rows columns 3"],
) -> PictureComparison:
    """Score linear pictures of one scene on the virtual view.

    All three share the exposure that shows the truth well. ``before`` gets the least-squares gain per channel,
    ``after`` none: restoration has to get the level right.

    Args:
        name: of the scene.
        before: without restoration, in e-/s.
        after: restored, in e-/s.
        truth: what a camera without a panel sees, in e-/s.
    """
    exposure = display_exposure(truth)
    blurred = encode_srgb(before * least_squares_gain(before, truth) * exposure)
    restored, ideal = encode_srgb(after * exposure), encode_srgb(truth * exposure)
    return PictureComparison(name, blurred, restored, ideal, _score(blurred, ideal), _score(restored, ideal))


def _score(picture: Float[np.ndarray, "rows columns 3"], truth: Float[np.ndarray, "rows columns 3"]) -> Score:
    return Score(psnr(picture, truth), ssim(picture, truth))


def mosaic_preview(
    mosaic: UInt16[np.ndarray, "rows columns"], cfa: str, black_DN: float
) -> Float[np.ndarray, "half_rows half_columns 3"]:
    """Return a linear picture of half the size with one pixel per 2 x 2 cell, without interpolation.

    Args:
        mosaic: raw frame in DN.
        cfa: pattern of its top-left 2 x 2, e.g. ``RGGB``.
        black_DN: black level.
    """
    return cfa_named(cfa).cell_means(np.maximum(mosaic.astype(np.float32) - np.float32(black_DN), 0.0))
