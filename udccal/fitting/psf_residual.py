"""The part of the kernel that diffraction does not explain: an image whose pixels are polynomials of the position.

All shots of all positions are solved together on Bayer sites: ridge regression by conjugate gradients, never forming
the matrix. A shot's expectation is the image at its position, moved by a fraction of a pixel and smeared by the LED's
disc; both are one small stencil per shot.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.ndimage
from jaxtyping import Array, Float

from udccal.fitting.psf_shots import Shots
from udccal.models.arrays import Arrayish
from udccal.models.fields import polynomial_basis

_STENCIL = 9
_REACH = _STENCIL // 2
_ITERATIONS = 60
_TOLERANCE = 1e-4
_PEAK_ERROR = 0.03


class Windows(eqx.Module):
    """All shots about their LED, in one window size.

    Attributes:
        basis: polynomials at each shot's position.
        stencil: shift and disc.
        flux: light of each sample's own colour, 0 where nothing is known.
        colour: one-hot.
        explained: per unit of light, what diffraction brings to each sample.
        rate: e-/s without background.
        weight: inverse variance of the rate.
    """

    basis: Float[Arrayish, "shots terms"]
    stencil: Float[Arrayish, "shots size size"]
    flux: Float[Arrayish, "shots rows columns"]
    colour: Float[Arrayish, "shots rows columns 3"]
    explained: Float[Arrayish, "shots rows columns"]
    rate: Float[Arrayish, "shots rows columns"]
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
) -> Windows:
    """Cut windows of ``half`` (rows, columns) to either side; ``explained`` covers these already.

    Args:
        unit: positions scaled to about [-1, 1].
        model_error: relative error of the peak that is allowed for, beside the noise of the data.
    """
    rows, columns = shots.rate.shape[1:]
    cut = np.s_[:, rows // 2 - half[0] : rows // 2 + half[0] + 1, columns // 2 - half[1] : columns // 2 + half[1] + 1]
    colour = np.eye(3)[shots.channel[cut]]
    rate = shots.rate[cut] - sources.background[:, None, None]
    flux = np.einsum("syxc,sc->syx", colour, sources.flux)
    known = shots.weight[cut] > 0
    smooth = np.maximum(scipy.ndimage.uniform_filter(np.abs(rate), (0, 3, 3)), np.abs(flux * explained))
    peak = smooth.max(axis=(1, 2), keepdims=True)
    # As in ``psf_normal.weighted``: what a smooth field leaves out matters the more, relatively, the fainter a sample.
    variance = 1.0 / np.where(known, shots.weight[cut], 1.0) + (model_error * smooth**0.75 * peak**0.25) ** 2
    return Windows(
        basis=np.asarray(polynomial_basis(unit, degree)),
        stencil=stencils(sources.place_px - shots.origin_px, shots.disc_px),
        flux=flux * known,
        colour=colour,
        explained=explained,
        rate=rate * known,
        weight=np.where(known, 1.0 / variance, 0.0),
    )


def stencils(
    offset_px: Float[np.ndarray, "shots 2"], disc_px: Float[np.ndarray, " shots"]
) -> Float[np.ndarray, "shots size size"]:
    """Weights that move an image by (x, y) and average it over a disc, by Lanczos's interpolation over six samples."""
    index = np.arange(64)
    radius, angle = np.sqrt((index + 0.5) / 64) / 2, index * np.pi * (3 - np.sqrt(5))
    disc = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)
    points = offset_px[:, None] + disc * disc_px[:, None, None]
    node = np.arange(-_REACH, _REACH + 1)
    along_x, along_y = (_lanczos(points[..., i, None] - node) for i in (0, 1))
    return np.einsum("spy,spx->syx", along_y, along_x) / len(index)


def _lanczos(distance: Float[np.ndarray, "*n taps"]) -> Float[np.ndarray, "*n taps"]:
    weight = np.where(np.abs(distance) < 3, np.sinc(distance) * np.sinc(distance / 3), 0.0)
    return weight / weight.sum(axis=-1, keepdims=True)


@eqx.filter_jit
def predict(windows: Windows, image: Float[Array, "terms 3 rows columns"]) -> Float[Array, "shots rows columns"]:
    """What the residual image brings to each sample per unit of light."""

    def one(shot: tuple[Array, Array, Array]) -> Float[Array, "rows columns"]:
        basis, stencil, colour = shot
        here = jnp.einsum("t,tcyx->cyx", basis, image)
        # A stencil moves towards +x where its weight lies at +x: this is convolution, so it is turned round.
        moved = jax.lax.conv_general_dilated(
            here[:, None], stencil[None, None, ::-1, ::-1], (1, 1), [(_REACH, _REACH)] * 2
        )[:, 0]
        return jnp.einsum("cyx,yxc->yx", moved, colour)

    return jax.lax.map(one, (jnp.asarray(windows.basis), jnp.asarray(windows.stencil), jnp.asarray(windows.colour)))


@eqx.filter_jit
def solve_residual(
    windows: Windows, share: Float[Arrayish, ""], spread: Float[Arrayish, "terms 3 rows columns"]
) -> Float[Array, "terms 3 rows columns"]:
    """Ridge estimate of the image with prior standard deviations ``spread``, ``share`` of diffraction being kept."""
    spread, flux, weight = jnp.asarray(spread), jnp.asarray(windows.flux), jnp.asarray(windows.weight)
    missing = jnp.asarray(windows.rate) - flux * share * jnp.asarray(windows.explained)

    def forward(scaled: Float[Array, "terms 3 rows columns"]) -> Float[Array, "shots rows columns"]:
        return flux * predict(windows, scaled * spread)

    backward = jax.linear_transpose(forward, jax.ShapeDtypeStruct(spread.shape, spread.dtype))

    def normal(scaled: Float[Array, "terms 3 rows columns"]) -> Float[Array, "terms 3 rows columns"]:
        return scaled + backward(weight * forward(scaled))[0]

    right = backward(weight * missing)[0]
    solution, _ = jax.scipy.sparse.linalg.cg(normal, right, tol=_TOLERANCE, maxiter=_ITERATIONS)
    return solution * spread


def refine_sources(
    shots: Shots, sources: Sources, windows: Windows, image: Float[np.ndarray, "terms 3 rows columns"]
) -> Sources:
    """One Gauss-Newton step of places and light of every shot for a given image (diffraction left out).

    Samples weigh nearly alike: an image that does not yet follow the field is right about the peak, not the wings.
    """
    step = 0.05
    offset = sources.place_px - shots.origin_px

    def at(move: tuple[float, float]) -> Float[np.ndarray, "shots rows columns"]:
        moved = stencils(offset + np.asarray(move), shots.disc_px)
        return np.asarray(predict(replace_stencil(windows, moved), jnp.asarray(image)))

    here = at((0.0, 0.0))
    slopes = [(at((step, 0.0)) - at((-step, 0.0))) / (2 * step), (at((0.0, step)) - at((0.0, -step))) / (2 * step)]
    place, flux = sources.place_px.copy(), sources.flux.copy()
    for s in range(shots.count):
        weight = np.asarray(windows.weight)[s]
        even = (_PEAK_ERROR * np.asarray(windows.rate)[s].max()) ** 2
        root = np.sqrt(np.where(weight > 0, 1.0 / (1.0 / np.where(weight > 0, weight, 1.0) + even), 0.0))
        own, colour = np.asarray(windows.flux)[s], np.asarray(windows.colour)[s]
        columns = [own * slope[s] for slope in slopes] + [own * here[s] * colour[..., c] for c in range(3)]
        design = np.stack([(column * root).ravel() for column in columns], axis=1)
        target = ((np.asarray(windows.rate)[s] - own * here[s]) * root).ravel()
        move = np.linalg.lstsq(design, target, rcond=1e-8)[0]
        place[s] += np.clip(move[:2], -0.5, 0.5)
        flux[s] *= 1.0 + np.clip(move[2:], -0.5, 0.5)
    return Sources(place, flux, sources.background)


def replace_stencil(windows: Windows, stencil: Float[np.ndarray, "shots size size"]) -> Windows:
    """The same windows with LEDs elsewhere."""
    return replace(windows, stencil=stencil)


def prior_spread(
    magnitude: Float[np.ndarray, "3 rows columns"], degree_terms: int, relative: float
) -> Float[np.ndarray, "terms 3 rows columns"]:
    """Prior standard deviation of every coefficient: a fraction of the kernel's own size near that pixel."""
    near = scipy.ndimage.maximum_filter(scipy.ndimage.gaussian_filter(np.abs(magnitude), (0, 0.7, 0.7)), (1, 3, 3))
    floor = 1e-5 * near.max(axis=(1, 2), keepdims=True)
    return np.tile((relative * (near + floor))[None], (degree_terms, 1, 1, 1))


def mismatch(
    windows: Windows, share: float, image: Float[np.ndarray, "terms 3 rows columns"]
) -> Float[np.ndarray, "3"]:
    """Relative L2 error per colour of the expectation, with what the data's own noise adds taken out."""
    unit = share * np.asarray(windows.explained) + np.asarray(predict(windows, jnp.asarray(image)))
    light = unit * np.asarray(windows.flux)
    error = (np.asarray(windows.rate) - light) ** 2
    colour, known = np.asarray(windows.colour), np.asarray(windows.weight) > 0
    size = np.einsum("syx,syxc->c", light**2 * known, colour)
    return np.sqrt(np.einsum("syx,syxc->c", error * known, colour) / np.maximum(size, 1e-30))
