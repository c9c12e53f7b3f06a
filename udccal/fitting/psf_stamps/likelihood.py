"""What is expected of every sample, how likely the samples are, and how they ask for changes.

Weights come from the model's own light (shot noise is that of the expectation, not of the sample), and clipped samples
bring what a clipped normal tells.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.special import log_ndtr

from udccal.fitting.psf_stamps.data import Plane
from udccal.fitting.psf_stamps.field import Seen, see
from udccal.fitting.psf_stamps.state import Scene, State


@dataclass(frozen=True)
class Weighted:
    """One colour's samples under the present model.

    Attributes:
        first: flat index of the first of a sample's 4 x 4 nodes.
        down, across: weights of these nodes times the star's light, as a product.
        slopes: to what a star may change by itself: relative light, centre (x, y), map (row by row).
        residual: what is left, in electrons. weight: inverse variances, 0 where nothing is known.
        mean: expected, in electrons.
    """

    first: Int[np.ndarray, "stars samples"]
    down: Float[np.ndarray, "stars samples 4"]
    across: Float[np.ndarray, "stars samples 4"]
    slopes: Float[np.ndarray, "stars samples own"]
    residual: Float[np.ndarray, "stars samples"]
    weight: Float[np.ndarray, "stars samples"]
    mean: Float[np.ndarray, "stars samples"]


def look(scene: Scene, state: State) -> tuple[Seen, ...]:
    """What the fields bring to all samples, by colour."""
    return tuple(
        see(field, scene.unit, state.centre_px, data.offset_px)
        for field, data in zip(state.fields, scene.planes, strict=True)
    )


def expectation(
    scene: Scene, state: State, plane: int, seen: Seen | None = None
) -> tuple[Weighted, Float[np.ndarray, "stars samples"]]:
    """One colour's samples under the model, and their log likelihood.

    Shot noise and read noise r together are those of y + r^2 ~ Poisson(m + r^2) (Snyder et al., J. Opt. Soc. Am. A 10,
    1993), whose score (y - m) / (m + r^2) asks for nothing but the variance.

    Args:
        scene: the samples.
        state: the model.
        plane: the colour.
        seen: what its field brings, where that is known already.
    """
    data = scene.planes[plane]
    if seen is None:
        seen = see(state.fields[plane], scene.unit, state.centre_px, data.offset_px)
    value, slopes, first, down, across, inside = (np.asarray(part) for part in seen)
    light = state.flux_e[:, plane, None]
    mean = light * value
    read = scene.read_e**2
    variance = np.maximum(mean, 0.0) + read  # expected light below zero has no shot noise
    likelihood = _unclipped(data, mean, variance, read)
    if state.model_error:
        variance = variance + (state.model_error * np.abs(mean)) ** 2
    residual, weight = data.value_e - mean, 1.0 / variance
    cut = data.clipped
    sigma = np.sqrt(variance[cut])
    z = (scene.clip_e - mean[cut]) / sigma
    score, told = _clipped(z)
    residual[cut], weight[cut], likelihood[cut] = sigma * score / told, told / variance[cut], log_ndtr(-z)
    known = data.usable & state.keep[plane] & inside
    own = np.concatenate([mean[..., None], light[..., None] * slopes], axis=2)
    residual, weight, likelihood = (np.where(known, part, 0.0) for part in (residual, weight, likelihood))
    return Weighted(first, light[..., None] * down, across, own, residual, weight, mean), likelihood


def _unclipped(
    data: Plane, mean: Float[np.ndarray, "stars samples"], variance: Float[np.ndarray, "stars samples"], read: float
) -> Float[np.ndarray, "stars samples"]:
    below = np.where(mean < 0, mean * data.value_e - 0.5 * mean**2, 0.0) / read
    return (data.value_e + read) * np.log(variance / read) - np.maximum(mean, 0.0) + below


def _clipped(z: Float[np.ndarray, "*n"]) -> tuple[Float[np.ndarray, "*n"], Float[np.ndarray, "*n"]]:
    """Score and information of a unit normal's mean where it is known only to lie above z."""
    hazard = np.exp(-0.5 * z**2 - 0.5 * np.log(2 * np.pi) - log_ndtr(-z))
    return hazard, np.maximum(hazard * (hazard - z), 1e-12)
