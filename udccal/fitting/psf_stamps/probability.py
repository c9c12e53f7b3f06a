"""How likely stamps are, and what is expected of a psf field beforehand.

Weights of samples come from the model's own light (shot noise is that of the expectation, not of the sample), and
clipped samples bring what a clipped normal tells.

Of a kernel it is expected that it has its own size, is smooth, and changes little over the field. Images of the same
degree share a Gaussian prior with the precision E^-1 (a + b D^2) E^-1, where E is the kernel's size nearby and D the
Laplacian on the nodes; maps and lateral colour share a precision per degree. The precisions are those that make the
data likeliest (empirical Bayes), by the updates of Fellner and Schall (Wood and Fasiolo, "A generalized Fellner-Schall
method for smoothing parameter optimization", Biometrics 73, 2017).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.ndimage
import scipy.sparse
from jaxtyping import Bool, Float, Int
from scipy.special import log_ndtr

from udccal.fitting.psf_stamps.data import Plane, Scene
from udccal.fitting.psf_stamps.field import Changes, PlaneField, degrees, see

# What a star may change by itself: relative light, centre (x, y), and the four numbers of its map, row by row.
OWN = 7
_NEAR_PX, _FLOOR = 1.5, 2e-5
# Precisions change by no more than this factor at a time, and end here: such a term is absent.
_STEP, _MOST = 30.0, 1e14
_WARP, _LATERAL = 4, 2  # numbers per polynomial


@dataclass(frozen=True)
class Precisions:
    """Of the priors of one colour.

    Attributes:
        image: (a, b) of each degree of the images, from 0.
        warp: of each degree of the map, from 1.
        lateral: of each degree of the lateral colour, from 1; empty for the colour that others are compared with.
    """

    image: Float[np.ndarray, "image_degrees 2"]
    warp: Float[np.ndarray, " warp_degrees"]
    lateral: Float[np.ndarray, " lateral_degrees"]

    @property
    def flat(self) -> Float[np.ndarray, " groups"]:
        """All of them."""
        return np.concatenate([self.image.ravel(), self.warp, self.lateral])

    def times(self, factors: Float[np.ndarray, " groups"]) -> Precisions:
        """Each multiplied with a factor of its own."""
        image, warp, lateral = np.split(self.flat * factors, np.cumsum([self.image.size, self.warp.size]))
        return Precisions(image.reshape(-1, 2), warp, lateral)

    @property
    def of_maps(self) -> Float[np.ndarray, " coefficients"]:
        """Of every coefficient of the map, then of the lateral colour."""
        return np.concatenate([self.warp[by_degree(self.warp, _WARP)], self.lateral[by_degree(self.lateral, _LATERAL)]])


@dataclass(frozen=True)
class Envelope:
    """The kernel's size E on the nodes, and how rough an image is beside it."""

    size: Float[np.ndarray, "grid_rows grid_columns"]
    roughness: scipy.sparse.csr_array
    eigenvalues: Float[np.ndarray, " nodes"]

    def scaled(self, images: Float[np.ndarray, "*n grid_rows grid_columns"]) -> Float[np.ndarray, "*n"]:
        """Sum of squares of images / E."""
        return np.asarray(((images / self.size) ** 2).sum(axis=(-2, -1)))

    def rough(self, images: Float[np.ndarray, "*n grid_rows grid_columns"]) -> Float[np.ndarray, "*n"]:
        """Sum of squares of the Laplacian of images / E."""
        z = images / self.size
        total = np.zeros_like(z)
        down, across = np.diff(z, axis=-2), np.diff(z, axis=-1)
        total[..., :-1, :] += down
        total[..., 1:, :] -= down
        total[..., :-1] += across
        total[..., 1:] -= across
        return np.asarray((total**2).sum(axis=(-2, -1)))


def envelope(image: Float[np.ndarray, "grid_rows grid_columns"], spacing_px: float) -> Envelope:
    """Of an image's nodes: their root mean square nearby."""
    near = scipy.ndimage.gaussian_filter(image**2, _NEAR_PX / spacing_px, mode="nearest")
    size = np.sqrt(near + (_FLOOR * np.abs(image).max()) ** 2)
    rows, columns = (_second_difference(n) for n in image.shape)
    one = [scipy.sparse.eye_array(n) for n in image.shape]
    laplacian = scipy.sparse.kron(rows, one[1]) + scipy.sparse.kron(one[0], columns)
    weighted = scipy.sparse.csr_array(laplacian) @ scipy.sparse.diags_array(1.0 / size.ravel())
    # The Laplacian's eigenvectors are those of the cosine transform.
    y, x = (2 - 2 * np.cos(np.pi * np.arange(n) / n) for n in image.shape)
    return Envelope(size, (weighted.T @ weighted).tocsr(), (y[:, None] + x).ravel() ** 2)


def by_degree(numbers: Float[np.ndarray, " degrees"], each: int) -> Int[np.ndarray, " coefficients"]:
    """For every coefficient of a polynomial without its constant: which of the numbers, one a degree, is its."""
    return np.repeat(degrees(len(numbers))[1:] - 1, each)


def squares(
    env: Envelope,
    precisions: Precisions,
    images: Float[np.ndarray, "k terms grid_rows grid_columns"],
    warp: Float[np.ndarray, "k warp"],
    lateral: Float[np.ndarray, "k lateral"],
) -> Float[np.ndarray, " groups"]:
    """What each precision is multiplied with in minus twice the log prior, on average over ``k`` fields."""
    degree = degrees(len(precisions.image) - 1)
    image = [np.bincount(degree, of(images).mean(axis=0)) for of in (env.scaled, env.rough)]
    maps = [
        np.bincount(by_degree(own, each), (values**2).mean(axis=0), minlength=len(own))
        for own, each, values in ((precisions.warp, _WARP, warp), (precisions.lateral, _LATERAL, lateral))
    ]
    return np.concatenate([np.stack(image, axis=1).ravel(), *maps])


def expected_squares(env: Envelope, precisions: Precisions) -> Float[np.ndarray, " groups"]:
    """The same, as the prior itself expects it."""
    out = []
    for degree, (a, b) in enumerate(precisions.image):
        prior = a + b * env.eigenvalues
        out += [(degree + 1) * (1.0 / prior).sum(), (degree + 1) * (env.eigenvalues / prior).sum()]
    return np.concatenate([out, *(count / own for own, count in _map_counts(precisions))])


def log_det(env: Envelope, precisions: Precisions) -> float:
    """Of the prior's precision; constants that all orders share are left out."""
    total = sum(float((count * np.log(own)).sum()) for own, count in _map_counts(precisions))
    for degree, (a, b) in enumerate(precisions.image):
        total += (degree + 1) * float(np.log(a + b * env.eigenvalues).sum() - 2 * np.log(env.size).sum())
    return total


def updated(
    precision: Float[np.ndarray, " n"],
    expected: Float[np.ndarray, " n"],
    left: Float[np.ndarray, " n"],
    found: Float[np.ndarray, " n"],
) -> Float[np.ndarray, " n"]:
    """Fellner and Schall's: squares that the prior expects, less those that the data leave open, over those found."""
    ratio = np.maximum(expected - left, 1e-6 * expected) / np.maximum(found, 1e-300)
    return np.minimum(precision * np.clip(ratio, 1 / _STEP, _STEP), _MOST)


def _map_counts(precisions: Precisions) -> list[tuple[Float[np.ndarray, " _degrees"], Float[np.ndarray, " _degrees"]]]:
    """Precisions of map and lateral colour, and how many coefficients share each."""
    pairs = ((precisions.warp, _WARP), (precisions.lateral, _LATERAL))
    return [(own, each * np.arange(2.0, len(own) + 2)) for own, each in pairs]


def _second_difference(n: int) -> scipy.sparse.csr_array:
    step = scipy.sparse.diags_array([-np.ones(n - 1), np.ones(n - 1)], offsets=[0, 1], shape=(n - 1, n))
    return scipy.sparse.csr_array(-(step.T @ step))


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
