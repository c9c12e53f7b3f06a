"""What is expected of a psf field before the data: of the kernel's own size and smooth, and the more even the better.

Images of the same degree share a Gaussian prior with the precision E^-1 (a + b D^2) E^-1, where E is the kernel's size
nearby and D the Laplacian on the nodes; maps and lateral colour share a precision per degree. The precisions are those
that make the data likeliest (marginal likelihood), by the updates of Fellner and Schall (Wood and Fasiolo, "A
generalized Fellner-Schall method for smoothing parameter optimization", Biometrics 73, 2017).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.ndimage
import scipy.sparse
from jaxtyping import Float

_NEAR_PX, _FLOOR = 1.5, 2e-5
# Precisions change by no more than this factor at a time, and end here: such a term is absent.
_STEP, _MOST = 30.0, 1e14


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
        total[..., 1:, :] += z[..., :-1, :] - z[..., 1:, :]
        total[..., :-1, :] += z[..., 1:, :] - z[..., :-1, :]
        total[..., :, 1:] += z[..., :, :-1] - z[..., :, 1:]
        total[..., :, :-1] += z[..., :, 1:] - z[..., :, :-1]
        return np.asarray((total**2).sum(axis=(-2, -1)))


def envelope(image: Float[np.ndarray, "grid_rows grid_columns"], spacing_px: float) -> Envelope:
    """Of an image's nodes: their root mean square nearby."""
    near = scipy.ndimage.gaussian_filter(image**2, _NEAR_PX / spacing_px, mode="nearest")
    size = np.sqrt(near + (_FLOOR * np.abs(image).max()) ** 2)
    rows, columns = image.shape
    laplacian = _laplacian(rows, columns)
    weighted = laplacian @ scipy.sparse.diags_array(1.0 / size.ravel())
    return Envelope(size, (weighted.T @ weighted).tocsr(), _eigenvalues(rows, columns))


def image_prior(
    env: Envelope, precisions: Float[np.ndarray, "degrees 2"]
) -> list[tuple[int, Float[np.ndarray, " nodes"], float]]:
    """For every image term: (term, diagonal a / E^2, b)."""
    terms = [degree for degree in range(len(precisions)) for _ in range(degree + 1)]
    flat = env.size.ravel() ** -2.0
    return [(term, precisions[degree, 0] * flat, float(precisions[degree, 1])) for term, degree in enumerate(terms)]


def log_det(env: Envelope, precisions: Float[np.ndarray, "degrees 2"]) -> float:
    """Of the images' prior precision."""
    total = 0.0
    for degree, (a, b) in enumerate(precisions):
        total += (degree + 1) * float(np.log(a + b * env.eigenvalues).sum() - 2 * np.log(env.size).sum())
    return total


def updated_image(
    env: Envelope,
    precisions: Float[np.ndarray, "degrees 2"],
    nodes: Float[np.ndarray, "terms grid_rows grid_columns"],
    draws: Float[np.ndarray, "draws terms grid_rows grid_columns"],
) -> Float[np.ndarray, "degrees 2"]:
    """Fellner and Schall's update; ``draws`` are of the posterior about its mode."""
    out = np.empty_like(precisions)
    start = 0
    for degree, (a, b) in enumerate(precisions):
        own = slice(start, start + degree + 1)
        start += degree + 1
        prior = a + b * env.eigenvalues
        for j, (of, trace) in enumerate(((env.scaled, 1.0 / prior), (env.rough, env.eigenvalues / prior))):
            expected = (degree + 1) * float(trace.sum())
            left = float(of(draws[:, own]).sum(axis=-1).mean())
            found = float(of(nodes[own]).sum())
            out[degree, j] = update(precisions[degree, j], expected, left, found)
    return out


def update(precision: float, expected: float, left: float, found: float) -> float:
    """One precision: what the prior expects less what the data leave open, over what was found."""
    ratio = max(expected - left, 1e-6 * expected) / max(found, 1e-300)
    return float(min(precision * np.clip(ratio, 1 / _STEP, _STEP), _MOST))


def _laplacian(rows: int, columns: int) -> scipy.sparse.csr_array:
    def along(n: int) -> scipy.sparse.csr_array:
        step = scipy.sparse.diags_array([-np.ones(n - 1), np.ones(n - 1)], offsets=[0, 1], shape=(n - 1, n))
        return scipy.sparse.csr_array(-(step.T @ step))

    one = scipy.sparse.eye_array
    return scipy.sparse.csr_array(
        scipy.sparse.kron(along(rows), one(columns)) + scipy.sparse.kron(one(rows), along(columns))
    )


def _eigenvalues(rows: int, columns: int) -> Float[np.ndarray, " nodes"]:
    """Of the squared Laplacian, whose eigenvectors are those of the cosine transform."""
    y, x = (2 - 2 * np.cos(np.pi * np.arange(n) / n) for n in (rows, columns))
    return ((y[:, None] + x).ravel()) ** 2
