"""What is expected of a psf field before the data: of the kernel's own size and smooth, and the more even the better.

Images of the same degree share a Gaussian prior with the precision E^-1 (a + b D^2) E^-1, where E is the kernel's size
nearby and D the Laplacian on the nodes; maps and lateral colour share a precision per degree. The precisions are those
that make the data likeliest (empirical Bayes), by the updates of Fellner and Schall (Wood and Fasiolo, "A generalized
Fellner-Schall method for smoothing parameter optimization", Biometrics 73, 2017).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.ndimage
import scipy.sparse
from jaxtyping import Float, Int

from udccal.fitting.psf_stamps.field import degrees

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
