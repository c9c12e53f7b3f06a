"""What the backscatter fit weighs: light of all shots at sampled positions, with the variance of each sample."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from udccal.fitting.backscatter.data import PanelCrop, PanelShots

# Variance of a bin's count is never below this many e-^2: a black picture in a camera without read noise.
LEAST_VARIANCE = 1 / 12
# exp(gamma times this) is nothing.
_LOG_OF_BLACK = -1e3


@dataclass(frozen=True)
class Pictures:
    """What the panel showed, as logarithms of its values over 255, in the part that the camera sees."""

    logs: Float[np.ndarray, "pictures pixels 3"]
    crop: PanelCrop


@dataclass(frozen=True)
class Evidence:
    """Light at sampled positions; white comes first among the shots.

    Attributes:
        rays: of the positions, in panel coordinates.
        light: rates in e-/s above the black level.
        shot: variance per rate, (e-/s)^2 per e-/s; also the rate of one electron in the bin.
        rest: variance of light in the dark.
        usable: False where samples are clipped or left out.
        dark, dark_variance: the dark frame.
        exposure: that of the dark frame over that of each shot.
        shown: what the panel showed, the pictures only.
    """

    rays: Float[np.ndarray, "n 3"]
    light: Float[np.ndarray, "shots 3 n"]
    shot: Float[np.ndarray, "shots 3 n"]
    rest: Float[np.ndarray, "shots 3 n"]
    usable: Bool[np.ndarray, "shots 3 n"]
    dark: Float[np.ndarray, "3 n"]
    dark_variance: Float[np.ndarray, "3 n"]
    exposure: Float[np.ndarray, " shots"]
    shown: Pictures


def pictures_of(shown: UInt8[np.ndarray, "pictures crop_rows crop_columns 3"], crop: PanelCrop) -> Pictures:
    """Pictures in the crop, ready for a fit of gamma."""
    values = shown.reshape(len(shown), crop.rows * crop.columns, 3) / 255.0
    return Pictures(np.where(values > 0, np.log(np.maximum(values, 1e-9)), _LOG_OF_BLACK), crop)


def evidence(
    shots: PanelShots, rays: Float[np.ndarray, "n 3"], flat: Int[np.ndarray, " n"], shown: Pictures
) -> Evidence:
    """What was measured at grid positions with these flat indices; ``shown`` is of the shots' pictures."""
    everything = (shots.white, *shots.seen)

    def at(plane: np.ndarray) -> np.ndarray:
        return plane.reshape(3, -1)[:, flat]

    return Evidence(
        rays=rays,
        light=np.stack([at(one.rate) for one in everything]),
        shot=np.stack([at(one.shot) for one in everything]),
        rest=np.stack([at(one.rest) for one in everything]),
        usable=np.stack([~at(one.clipped) for one in everything]),
        dark=at(shots.dark.rate),
        dark_variance=np.maximum(at(shots.dark.rest), LEAST_VARIANCE * at(shots.dark.shot) ** 2),
        exposure=np.array([shots.dark.exposure_s / one.exposure_s for one in everything]),
        shown=shown,
    )


def weights(
    seen: Evidence,
    rate: Float[np.ndarray, "shots 3 n"],
    mask: Float[np.ndarray, "3 n"],
    share: float,
    usable: Bool[np.ndarray, "shots 3 n"],
) -> Float[np.ndarray, "shots 3 n"]:
    """1 / sigma of every sample at a modelled rate; ``share`` of the mask is what the model leaves undescribed."""
    variance = np.maximum(seen.shot * np.maximum(rate, 0.0) + seen.rest, LEAST_VARIANCE * seen.shot**2)
    # White is the mask by definition: the model takes no part in it.
    variance[1:] += (share * mask) ** 2
    return np.where(usable, 1 / np.sqrt(variance), 0.0)


def weights_to_start(seen: Evidence) -> Float[np.ndarray, "shots 3 n"]:
    """Weights by what was measured, one electron on the safe side."""
    light = seen.light - seen.exposure[:, None, None] * seen.dark
    nothing = np.zeros(light.shape[1:])
    return weights(seen, np.maximum(light, 0.0) + seen.shot, nothing, 0.0, seen.usable)
