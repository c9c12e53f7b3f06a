"""What is expected of every sample, how likely the samples are, and how they ask for changes.

Weights come from the model's own light (shot noise is that of the expectation, not of the sample), and clipped samples
bring what a clipped normal tells.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import log_ndtr

from udccal.fitting.psf_stamps.data import Plane
from udccal.fitting.psf_stamps.field import Changes, PlaneField, see
from udccal.fitting.psf_stamps.prior import Envelope, Precisions, log_det, squares

# What a star may change by itself: relative light, centre (x, y), and the four numbers of its map, row by row.
OWN = 7


@dataclass(frozen=True)
class Scene:
    """What does not change during a fit.

    Attributes:
        planes: samples by colour.
        unit: positions scaled to about [-1, 1].
        shape: rows and columns of a stamp.
        read_e, clip_e: of the samples' noise.
    """

    planes: tuple[Plane, ...]
    unit: Float[np.ndarray, "stars 2"]
    shape: tuple[int, int]
    read_e: float
    clip_e: float

    @property
    def samples(self) -> int:
        """That tell something."""
        return sum(int(plane.usable.sum()) for plane in self.planes)


@dataclass(frozen=True)
class State:
    """Where a fit has come to.

    Attributes:
        fields: by colour.
        centre_px: of the stars, from their middle samples.
        flux_e: by star and colour.
        precisions, envelopes: of the priors, by colour.
        keep: samples that are not outliers, by colour.
        model_error: relative error of the model that is allowed for beside the noise, while it is still coarse.
    """

    fields: tuple[PlaneField, ...]
    centre_px: Float[np.ndarray, "stars 2"]
    flux_e: Float[np.ndarray, "stars planes"]
    precisions: tuple[Precisions, ...]
    envelopes: tuple[Envelope, ...]
    keep: tuple[Bool[np.ndarray, "stars _samples"], ...]
    model_error: float = 0.0

    @property
    def maps_from(self) -> int:
        """Index in the dense block of the first coefficient of a map: behind places and light of the stars."""
        return self.centre_px.size + self.flux_e.size

    @property
    def numbers(self) -> int:
        """Parameters of the fields."""
        return sum(np.size(f.nodes) + np.size(f.warp) + np.size(f.lateral) for f in self.fields)

    @property
    def out(self) -> Bool[np.ndarray, " stars"]:
        """Stars that are left out altogether."""
        return ~np.any([keep.any(axis=1) for keep in self.keep], axis=0)

    def shifted(self, vector: Float[np.ndarray, " unknowns"]) -> State:
        """The state with changes added, in the order of ``Changes``."""
        changes = Changes.of(self.fields, len(self.flux_e), vector[:, None])
        return replace(
            self,
            fields=changes.applied(self.fields),
            centre_px=self.centre_px + changes.stars[:, :2, 0],
            flux_e=self.flux_e * np.exp(changes.stars[:, 2:, 0]),
        )

    def squares(self, vectors: Float[np.ndarray, "unknowns k"] | None = None) -> Float[np.ndarray, " groups"]:
        """Of the fields, or on average of changes of them: what the precisions of all colours are multiplied with."""
        if vectors is None:
            parts = [(f.nodes[None], np.reshape(f.warp, (1, -1)), np.reshape(f.lateral, (1, -1))) for f in self.fields]
        else:
            c = Changes.of(self.fields, len(self.flux_e), vectors)
            parts = [
                (nodes.transpose(2, 0, 1).reshape(-1, *f.nodes.shape), warp.T, lateral.T)
                for f, nodes, warp, lateral in zip(self.fields, c.nodes, c.warp, c.lateral, strict=True)
            ]
        return np.concatenate(
            [squares(env, own, *part) for env, own, part in zip(self.envelopes, self.precisions, parts, strict=True)]
        )

    @property
    def log_prior(self) -> float:
        """Log prior; constants that all orders share are left out."""
        volume = sum(log_det(env, own) for env, own in zip(self.envelopes, self.precisions, strict=True))
        return 0.5 * (volume - float(np.concatenate([own.flat for own in self.precisions]) @ self.squares()))


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


def expectation(scene: Scene, state: State, plane: int) -> tuple[Weighted, Float[np.ndarray, "stars samples"]]:
    """One colour's samples under the model, and their log likelihood.

    Shot noise and read noise r together are those of y + r^2 ~ Poisson(m + r^2) (Snyder et al., J. Opt. Soc. Am. A 10,
    1993), whose score (y - m) / (m + r^2) asks for nothing but the variance.

    Args:
        scene: the samples.
        state: the model.
        plane: the colour.
    """
    data = scene.planes[plane]
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
    if state.model_error:
        likelihood = -0.5 * (residual**2 * weight + np.log(variance / read))
    cut = data.clipped
    sigma = np.sqrt(variance[cut])
    z = (scene.clip_e - mean[cut]) / sigma
    score, information = _clipped(z)
    residual[cut], weight[cut], likelihood[cut] = sigma * score / information, information / variance[cut], log_ndtr(-z)
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
