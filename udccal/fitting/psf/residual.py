"""The part of the kernel that diffraction does not explain: an image whose nodes are polynomials of the position.

All shots of all positions are solved together on Bayer sites: ridge regression by conjugate gradients, never forming
the matrix. A shot's expectation is the image at its position, moved by a fraction of a pixel and smeared by the LED's
disc. Along rows and along columns that is one small matrix each (for a disc of a pixel or two, which pixels cannot tell
from the product of its shadows).

Beside diffraction one node to a pixel is enough; see ``psf.free`` for an image that carries the whole kernel.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.ndimage
from jaxtyping import Array, Float

from udccal.fitting.psf.shots import Shots
from udccal.fitting.psf.weights import noise_at
from udccal.models.arrays import Arrayish
from udccal.models.fields import polynomial_basis

_LANCZOS = 3
_DISC_POINTS = 8


class Windows(eqx.Module):
    """All shots about their LED, in one window size.

    Attributes:
        basis: polynomials at each shot's position.
        down, across: from nodes to samples, along columns and along rows: shift and disc.
        flux: light of each sample's own colour, 0 where nothing is known.
        colour: one-hot.
        explained: per unit of light, what diffraction brings to each sample.
        rate: e-/s without background.
        variance: of the rate as it was measured, 1 where nothing is known; it grows with the light by noise_per_rate.
        left_out: what a model error of 1 would add to the rate's standard deviation; see ``psf.weights``.
        weight: inverse variance of the rate that solutions go by, 0 where nothing is known.
    """

    basis: Float[Arrayish, "shots terms"]
    down: Float[Arrayish, "shots rows node_rows"]
    across: Float[Arrayish, "shots columns node_columns"]
    flux: Float[Arrayish, "shots rows columns"]
    colour: Float[Arrayish, "shots rows columns 3"]
    explained: Float[Arrayish, "shots rows columns"]
    rate: Float[Arrayish, "shots rows columns"]
    variance: Float[Arrayish, "shots rows columns"]
    noise_per_rate: Float[Arrayish, "shots rows columns"]
    left_out: Float[Arrayish, "shots rows columns"]
    weight: Float[Arrayish, "shots rows columns"]


@dataclass(frozen=True)
class Sources:
    """Where each shot's LED is and how bright: (x, y) on the sensor in px, e-/s per colour, background in e-/s."""

    place_px: Float[np.ndarray, "shots 2"]
    flux: Float[np.ndarray, "shots 3"]
    background: Float[np.ndarray, " shots"]

    def pick(self, keep: np.ndarray) -> Sources:
        """The shots selected by an index or mask."""
        return Sources(self.place_px[keep], self.flux[keep], self.background[keep])


def with_light_of_peak(shots: Shots, sources: Sources, explained: Float[np.ndarray, "shots rows columns"]) -> Sources:
    """Light per colour from unweighted least squares: set by the peak, where relative weights listen to the wings."""
    colour = np.eye(3)[shots.channel] * (shots.weight > 0)[..., None]
    rate = shots.rate - sources.background[:, None, None]
    top = np.einsum("syx,syx,syxc->sc", rate, explained, colour)
    bottom = np.einsum("syx,syx,syxc->sc", explained, explained, colour)
    return replace(sources, flux=np.where(bottom > 0, top / np.where(bottom > 0, bottom, 1.0), sources.flux))


def make_windows(
    shots: Shots,
    sources: Sources,
    explained: Float[np.ndarray, "shots rows columns"],
    half: tuple[int, int],
    unit: Float[np.ndarray, "shots 2"],
    degree: int,
    model_error: float,
    per_px: int = 1,
) -> Windows:
    """Cut windows of ``half`` (rows, columns) to either side; ``explained`` covers these already.

    Args:
        unit: positions scaled to about [-1, 1].
        model_error: relative error of the peak that solutions allow for, beside the noise of the data.
        per_px: nodes of the image to a pixel; its first and last lie on the first and last pixels.
    """
    rows, columns = shots.rate.shape[1:]
    cut = np.s_[:, rows // 2 - half[0] : rows // 2 + half[0] + 1, columns // 2 - half[1] : columns // 2 + half[1] + 1]
    colour = np.eye(3)[shots.channel[cut]]
    rate = shots.rate[cut] - sources.background[:, None, None]
    flux = np.einsum("syxc,sc->syx", colour, sources.flux)
    known = shots.weight[cut] > 0
    smooth = np.maximum(scipy.ndimage.uniform_filter(np.abs(rate), (0, 3, 3)), np.abs(flux * explained))
    peak = smooth.max(axis=(1, 2), keepdims=True)
    # As in ``psf.weights``: what a smooth field leaves out matters the more, relatively, the fainter a sample.
    left_out = smooth**0.75 * peak**0.25
    measured, slope = 1.0 / np.where(known, shots.weight[cut], 1.0), shots.noise_per_rate[cut]
    variance = noise_at(smooth, rate, measured, slope) + (model_error * left_out) ** 2
    offset = sources.place_px - shots.origin_px
    return Windows(
        basis=np.asarray(polynomial_basis(unit, degree)),
        down=shifts(offset[:, 1], shots.disc_px, 2 * half[0] + 1, per_px),
        across=shifts(offset[:, 0], shots.disc_px, 2 * half[1] + 1, per_px),
        flux=flux * known,
        colour=colour,
        explained=explained,
        rate=rate * known,
        variance=measured,
        noise_per_rate=slope,
        left_out=left_out,
        weight=np.where(known, 1.0 / variance, 0.0),
    )


def shifts(
    offset_px: Float[np.ndarray, " shots"], disc_px: Float[np.ndarray, " shots"], samples: int, per_px: int = 1
) -> Float[np.ndarray, "shots samples nodes"]:
    """Matrices along one axis that move an image by an offset and average it over a disc's shadow.

    Lanczos's interpolation over six nodes; the shadow of a disc is summed by Gauss and Chebyshev's rule.
    """
    angle = np.pi * np.arange(1, _DISC_POINTS + 1) / (_DISC_POINTS + 1)
    shots, nodes = len(offset_px), per_px * (samples - 1) + 1
    matrix = np.zeros((shots, samples, nodes + 2 * _LANCZOS))  # what falls beside the nodes is cut off at the end
    index = np.ogrid[:shots, :samples]
    for part, weight in zip(np.cos(angle) / 2, 2 / (_DISC_POINTS + 1) * np.sin(angle) ** 2, strict=True):
        place = per_px * (np.arange(samples) - (offset_px + part * disc_px)[:, None])
        first = np.floor(place).astype(np.int64) - _LANCZOS + 1
        taps = np.stack([_lanczos(place - first - tap) for tap in range(2 * _LANCZOS)])
        for tap, value in enumerate(weight * taps / taps.sum(axis=0)):
            matrix[(*index, np.clip(first + tap + _LANCZOS, 0, matrix.shape[2] - 1))] += value
    return matrix[:, :, _LANCZOS:-_LANCZOS]


def _lanczos(distance: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    return np.where(np.abs(distance) < _LANCZOS, np.sinc(distance) * np.sinc(distance / _LANCZOS), 0.0)


def about_middle(images: Float[np.ndarray, "*k rows columns"], half: tuple[int, int]) -> np.ndarray:
    """The middle of images of odd size, ``half`` (rows, columns) to either side."""
    rows, columns = (slice(n // 2 - h, n // 2 + h + 1) for n, h in zip(images.shape[-2:], half, strict=True))
    return images[..., rows, columns]


@eqx.filter_jit
def predict(
    windows: Windows, image: Float[Array, "terms 3 node_rows node_columns"]
) -> Float[Array, "shots rows columns"]:
    """What the residual image brings to each sample per unit of light."""

    def one(shot: tuple[Array, Array, Array, Array]) -> Float[Array, "rows columns"]:
        basis, down, across, colour = shot
        moved = down @ jnp.einsum("t,tcyx->cyx", basis, image) @ across.T
        return jnp.einsum("cyx,yxc->yx", moved, colour)

    parts = (windows.basis, windows.down, windows.across, windows.colour)
    return jax.lax.map(one, tuple(jnp.asarray(part) for part in parts))


@eqx.filter_jit
def solve_residual(
    windows: Windows, share: Float[Arrayish, ""], spread: Float[Arrayish, "terms 3 node_rows node_columns"]
) -> Float[Array, "terms 3 node_rows node_columns"]:
    """Ridge estimate of the image with prior standard deviations ``spread``, ``share`` of diffraction being kept."""
    spread, flux, weight = jnp.asarray(spread), jnp.asarray(windows.flux), jnp.asarray(windows.weight)
    missing = jnp.asarray(windows.rate) - flux * share * jnp.asarray(windows.explained)

    def forward(scaled: Float[Array, "terms 3 node_rows node_columns"]) -> Float[Array, "shots rows columns"]:
        return flux * predict(windows, scaled * spread)

    return ridge(forward, lambda light: weight * light, missing, spread) * spread


def ridge(
    forward: Callable[[Array], Array],
    weigh: Callable[[Array], Array],
    data: Float[Array, "shots rows columns"],
    like: Float[Array, "terms 3 node_rows node_columns"],
    iterations: int = 60,
    tolerance: float = 1e-4,
) -> Float[Array, "terms 3 node_rows node_columns"]:
    """The image of unit prior that explains ``data`` best, by conjugate gradients on the normal equations.

    Args:
        forward: linear, from an image to light. weigh: the data's inverse covariance.
        data: light. like: an array of the image's shape.
        iterations: at most. tolerance: relative residual at which they end.
    """
    backward = jax.linear_transpose(forward, jax.ShapeDtypeStruct(like.shape, like.dtype))

    def normal(image: Array) -> Array:
        return image + backward(weigh(forward(image)))[0]

    right = backward(weigh(data))[0]
    return jax.scipy.sparse.linalg.cg(normal, right, tol=tolerance, maxiter=iterations)[0]


def prior_spread(
    magnitude: Float[np.ndarray, "3 rows columns"], degree_terms: int, relative: float, per_px: int = 1
) -> Float[np.ndarray, "terms 3 node_rows node_columns"]:
    """Prior standard deviation of every coefficient: a fraction of the kernel's own size near that node."""
    near = scipy.ndimage.maximum_filter(scipy.ndimage.gaussian_filter(np.abs(magnitude), (0, 0.7, 0.7)), (1, 3, 3))
    near = near + 1e-5 * near.max(axis=(1, 2), keepdims=True)
    nodes = [1.0, *((per_px * (size - 1) + 1) / size for size in near.shape[1:])]
    return np.tile(relative * scipy.ndimage.zoom(near, nodes, order=1)[None], (degree_terms, 1, 1, 1))


def mismatch(
    windows: Windows, share: float, image: Float[np.ndarray, "terms 3 node_rows node_columns"]
) -> Float[np.ndarray, "3"]:
    """Relative L2 error per colour of the expectation, the data's own noise included."""
    light = expected(windows, share, image)
    error = (np.asarray(windows.rate) - light) ** 2
    colour, known = np.asarray(windows.colour), np.asarray(windows.weight) > 0
    size = np.einsum("syx,syxc->c", light**2 * known, colour)
    return np.sqrt(np.einsum("syx,syxc->c", error * known, colour) / np.maximum(size, 1e-30))


def expected(
    windows: Windows, share: float, image: Float[np.ndarray, "terms 3 node_rows node_columns"]
) -> Float[np.ndarray, "shots rows columns"]:
    """What diffraction and image together bring to each sample, in e-/s."""
    unit = share * np.asarray(windows.explained) + np.asarray(predict(windows, jnp.asarray(image)))
    return unit * np.asarray(windows.flux)
