"""The part of the kernel that diffraction does not explain: an image whose nodes are polynomials of the position.

All shots of all positions are solved together on Bayer sites: ridge regression by conjugate gradients, never forming
the matrix. A shot's expectation is the image at its position, moved by a fraction of a pixel and smeared by the LED's
disc. Along rows and along columns that is one small matrix each (for a disc of a pixel or two, which pixels cannot tell
from the product of its shadows).

Beside diffraction one node to a pixel is enough; see ``psf.free`` for an image that carries the whole kernel.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.ndimage
from jaxtyping import Array, Bool, Float

from udccal.fitting.psf.data import Shots
from udccal.fitting.psf.weights import left_out, noise_at
from udccal.models.arrays import Arrayish

_LANCZOS: Final = 3
_DISC_POINTS: Final = 8
_SMOOTH_NODES: Final = 1.0
# Iterations at most and relative residual of conjugate gradients: beside diffraction, and without it.
_BESIDE, _FREE = (60, 1e-4), (150, 1e-5)
# Centroids are this good, in px; sums of a crop's light, relatively.
_PLACE_SIGMA_PX, _LIGHT_SIGMA = 0.05, 0.03


@final
@dataclass(frozen=True)
class Sources:
    """Where each shot's LED is and how bright: (x, y) on the sensor in px, e-/s per colour, background in e-/s."""

    place_px: Float[np.ndarray, "shots 2"]
    flux: Float[np.ndarray, "shots 3"]
    background: Float[np.ndarray, " shots"]

    def pick(self, keep: np.ndarray) -> Sources:
        """The shots selected by an index or mask."""
        return Sources(self.place_px[keep], self.flux[keep], self.background[keep])

    def with_light_of_peak(self, shots: Shots, explained: Float[np.ndarray, "shots rows columns"]) -> Sources:
        """Light from unweighted least squares: set by the peak, where relative weights listen to the wings."""
        colour = np.eye(3)[shots.channel] * (shots.weight > 0)[..., None]
        rate = shots.rate - self.background[:, None, None]
        top = np.einsum("syx,syx,syxc->sc", rate, explained, colour)
        bottom = np.einsum("syx,syx,syxc->sc", explained, explained, colour)
        return replace(self, flux=np.where(bottom > 0, top / np.where(bottom > 0, bottom, 1.0), self.flux))


@final
class Windows(eqx.Module):
    """All shots about their LED.

    Attributes:
        basis: polynomials at each shot's position.
        down, across: from nodes to samples, along columns and along rows: shift and disc.
        flux: light of each sample's own colour, 0 where nothing is known.
        colour: one-hot.
        explained: per unit of light, what diffraction brings to each sample.
        rate: e-/s without background.
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
    left_out: Float[Arrayish, "shots rows columns"]
    weight: Float[Arrayish, "shots rows columns"]

    def only(self, keep: Bool[np.ndarray, " shots"]) -> Windows:
        """With no weight on the other shots: of one shape whichever are kept, compiled but once."""
        return replace(self, weight=self.weight * keep[:, None, None])

    def expected(
        self, share: float, image: Float[np.ndarray, "terms 3 node_rows node_columns"]
    ) -> Float[np.ndarray, "shots rows columns"]:
        """What a ``share`` of diffraction and an image together bring to each sample, in e-/s."""
        return (share * np.asarray(self.explained) + np.asarray(predict(self, image))) * np.asarray(self.flux)


def make_windows(
    shots: Shots,
    sources: Sources,
    explained: Float[np.ndarray, "shots rows columns"],
    basis: Float[np.ndarray, "shots terms"],
    model_error: float,
    per_px: int = 1,
) -> Windows:
    """What images are solved from.

    Args:
        shots: the data. sources: their places and light.
        explained: per unit of light, what diffraction brings to each sample.
        basis: polynomials at each shot's position.
        model_error: relative error of the peak that solutions allow for, beside the noise of the data.
        per_px: nodes of the image to a pixel; its first and last lie on the first and last pixels.
    """
    colour = np.eye(3)[shots.channel]
    rate = shots.rate - sources.background[:, None, None]
    flux = np.einsum("syxc,sc->syx", colour, sources.flux)
    known = shots.weight > 0
    smooth = np.maximum(scipy.ndimage.uniform_filter(np.abs(rate), (0, 3, 3)), np.abs(flux * explained))
    unexplained = left_out(smooth.reshape(shots.count, -1), 1.0).reshape(smooth.shape)
    measured = 1.0 / np.where(known, shots.weight, 1.0)
    variance = noise_at(smooth, rate, measured, shots.noise_per_rate) + (model_error * unexplained) ** 2
    x, y = (sources.place_px - shots.origin_px).T
    return Windows(
        basis=basis,
        down=shifts(y, shots.disc_px, shots.rate.shape[1], per_px),
        across=shifts(x, shots.disc_px, shots.rate.shape[2], per_px),
        flux=flux * known,
        colour=colour,
        explained=explained,
        rate=rate * known,
        left_out=unexplained,
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
        away = np.stack([place - first - tap for tap in range(2 * _LANCZOS)])
        taps = np.where(np.abs(away) < _LANCZOS, np.sinc(away) * np.sinc(away / _LANCZOS), 0.0)
        for tap, value in enumerate(weight * taps / taps.sum(axis=0)):
            matrix[(*index, np.clip(first + tap + _LANCZOS, 0, matrix.shape[2] - 1))] += value
    return matrix[:, :, _LANCZOS:-_LANCZOS]


def about_middle(images: Float[np.ndarray, "*k rows columns"], half: tuple[int, int]) -> np.ndarray:
    """The middle of images of odd size, ``half`` (rows, columns) to either side."""
    rows, columns = (slice(n // 2 - h, n // 2 + h + 1) for n, h in zip(images.shape[-2:], half, strict=True))
    return images[..., rows, columns]


def prior_sigma(
    magnitude: Float[np.ndarray, "3 rows columns"], relative: float, per_px: int = 1
) -> Float[np.ndarray, "3 node_rows node_columns"]:
    """Prior standard deviation of every coefficient: a fraction of the kernel's own size near that node."""
    near = scipy.ndimage.maximum_filter(scipy.ndimage.gaussian_filter(np.abs(magnitude), (0, 0.7, 0.7)), (1, 3, 3))
    near = near + 1e-5 * near.max(axis=(1, 2), keepdims=True)
    nodes = [1.0, *((per_px * (size - 1) + 1) / size for size in near.shape[1:])]
    return np.asarray(relative * scipy.ndimage.zoom(near, nodes, order=1))


@eqx.filter_jit
def predict(
    windows: Windows, image: Float[Arrayish, "terms 3 node_rows node_columns"]
) -> Float[Array, "shots rows columns"]:
    """What an image brings to each sample per unit of light."""

    def one(shot: tuple[Array, Array, Array, Array]) -> Float[Array, "rows columns"]:
        basis, down, across, colour = shot
        moved = down @ jnp.einsum("t,tcyx->cyx", basis, jnp.asarray(image)) @ across.T
        return jnp.einsum("cyx,yxc->yx", moved, colour)

    parts = (windows.basis, windows.down, windows.across, windows.colour)
    return jax.lax.map(one, tuple(jnp.asarray(part) for part in parts))


@final
class Moves(eqx.Module):
    """What shots may change by themselves along with a free image: place in px (x, y), and relative light (R, G, B).

    Attributes:
        design: what a change brings to each sample, in e-/s.
        changed: by how much they have been changed.
    """

    design: Float[Arrayish, "shots 5 rows columns"]
    changed: Float[Arrayish, "shots 5"]


@eqx.filter_jit
def solve_image(
    windows: Windows,
    sigma: Float[Arrayish, "terms 3 node_rows node_columns"],
    share: Float[Arrayish, ""],
    before: Float[Arrayish, "terms 3 node_rows node_columns"] | None = None,
    moves: Moves | None = None,
) -> tuple[Float[Array, "terms 3 node_rows node_columns"], Float[Array, "shots 5"] | None]:
    """Ridge estimate of an image, beside a ``share`` of diffraction.

    Args:
        windows: the data.
        sigma: prior standard deviations of the image, before it is smoothed.
        share: 1, or 0 without diffraction.
        before: for a free image, one that was returned before; None beside diffraction.
        moves: places and light of the shots, which are estimated along; None where they stay.

    Returns:
        (image in units of ``sigma``, for ``image_of``; by how much each shot's own parameters are changed now).
    """
    sigma, flux, weight = (jnp.asarray(part) for part in (sigma, windows.flux, windows.weight))
    free, start = before is not None, jnp.zeros_like(sigma) if before is None else jnp.asarray(before)
    data = jnp.asarray(windows.rate) - flux * share * jnp.asarray(windows.explained)
    design = None if moves is None else jnp.asarray(moves.design)

    def own_of(light: Float[Array, "shots rows columns"]) -> Float[Array, "shots 5"]:
        prior = jnp.array([_PLACE_SIGMA_PX] * 2 + [_LIGHT_SIGMA] * 3) ** -2.0
        inverse = jnp.linalg.inv(jnp.einsum("spyx,sqyx,syx->spq", design, design, weight) + jnp.diag(prior))
        return jnp.einsum("spq,sqyx,syx->sp", inverse, design, weight * light)

    def weigh(light: Float[Array, "shots rows columns"]) -> Float[Array, "shots rows columns"]:
        return weight * (light if design is None else light - jnp.einsum("spyx,sp->syx", design, own_of(light)))

    def forward(scaled: Float[Array, "terms 3 node_rows node_columns"]) -> Float[Array, "shots rows columns"]:
        return flux * predict(windows, image_of(scaled, sigma, free))

    if moves is not None:
        # As if nothing had been changed yet: the model is linear, and the prior is about the whole change.
        data = data + jnp.einsum("spyx,sp->syx", design, jnp.asarray(moves.changed))
    # The prior is about what is added. About the whole, it would trade a smaller image for brighter LEDs.
    missing = data - forward(start) if free else data
    backward = jax.linear_transpose(forward, jax.ShapeDtypeStruct(sigma.shape, sigma.dtype))
    iterations, tolerance = _FREE if free else _BESIDE
    scaled, _ = jax.scipy.sparse.linalg.cg(
        lambda image: image + backward(weigh(forward(image)))[0],
        backward(weigh(missing))[0],
        tol=tolerance,
        maxiter=iterations,
    )
    scaled = start + scaled
    return scaled, None if moves is None else own_of(data - forward(scaled))


def image_of(
    scaled: Float[Arrayish, "terms 3 node_rows node_columns"],
    sigma: Float[Arrayish, "terms 3 node_rows node_columns"],
    free: bool,
) -> Float[Array, "terms 3 node_rows node_columns"]:
    """The image: what has the prior's standard deviations, smoothed by a Gaussian along both axes where it is free."""
    image = jnp.asarray(scaled) * jnp.asarray(sigma)
    if not free:
        return image
    reach = int(np.ceil(4 * _SMOOTH_NODES))
    taps = np.exp(-0.5 * (np.arange(-reach, reach + 1) / _SMOOTH_NODES) ** 2)
    taps /= taps.sum()
    planes = image.reshape(-1, 1, *image.shape[-2:])
    for axis in (0, 1):
        kernel = jnp.asarray(np.expand_dims(taps, 1 - axis))[None, None]
        around = [(reach, reach) if a == axis else (0, 0) for a in (0, 1)]
        planes = jax.lax.conv_general_dilated(planes, kernel, (1, 1), around)
    return planes.reshape(image.shape)
