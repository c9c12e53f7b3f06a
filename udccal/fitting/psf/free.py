"""An image that carries the whole kernel, when diffraction explains none of it: finer than pixels, smooth across one.

A core about as narrow as a pixel is not determined by its values on whole pixels: moving those by a fraction of one is
wrong by some percent, and undoing the LED's disc makes more of it. The image therefore has two nodes to a pixel. No
shot sees all of them, but all shots at their places do together, and what pixels integrate is smooth over about one.

Where the LEDs are and how bright is estimated along with the image: in every round the model is linear in both, and
each shot's own unknowns are eliminated exactly (Golub and Pereyra, "The differentiation of pseudo-inverses and
nonlinear least squares problems whose variables separate", 1973).
"""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udccal.fitting.psf.residual import Sources, Windows, predict, ridge, shifts
from udccal.fitting.psf.shots import Shots
from udccal.models.arrays import Arrayish

PER_PX = 2
_SMOOTH_NODES = 1.0
_ITERATIONS, _TOLERANCE = 150, 1e-5
_STEP_PX = 0.05
# Centroids are this good, in px; sums of a crop's light, relatively.
_PLACE_SIGMA_PX, _LIGHT_SIGMA = 0.05, 0.03


class Own(eqx.Module):
    """What every shot may change by itself: place in px (x, y), and relative light (R, G, B).

    Attributes:
        design: what a change brings to each sample, in e-/s; zero where places and light are to stay.
        changed: by how much they have been changed.
    """

    design: Float[Arrayish, "shots 5 rows columns"]
    changed: Float[Arrayish, "shots 5"]


def fixed(windows: Windows) -> Own:
    """Places and light that stay."""
    shots, rows, columns = np.shape(windows.rate)
    return Own(np.zeros((shots, 5, rows, columns)), np.zeros((shots, 5)))


def movable(
    shots: Shots,
    sources: Sources,
    windows: Windows,
    image: Float[np.ndarray, "terms 3 node_rows node_columns"],
    changed: Float[np.ndarray, "shots 5"],
) -> Own:
    """Places and light about ``sources``, at which they have been ``changed`` by so much, under an image."""
    rows, columns = np.shape(windows.rate)[1:]
    x, y = (sources.place_px - shots.origin_px).T

    def at(move: tuple[float, float]) -> Float[np.ndarray, "shots rows columns"]:
        down = shifts(y + move[1], shots.disc_px, rows, PER_PX)
        across = shifts(x + move[0], shots.disc_px, columns, PER_PX)
        return np.asarray(predict(replace(windows, down=down, across=across), jnp.asarray(image)))

    h = _STEP_PX
    slopes = [(at((h, 0.0)) - at((-h, 0.0))) / (2 * h), (at((0.0, h)) - at((0.0, -h))) / (2 * h)]
    light = at((0.0, 0.0))[..., None] * np.asarray(windows.colour)
    unit = np.concatenate([np.stack(slopes, axis=1), np.moveaxis(light, -1, 1)], axis=1)
    return Own(unit * np.asarray(windows.flux)[:, None], changed)


@eqx.filter_jit
def solve_free(
    windows: Windows,
    spread: Float[Arrayish, "terms 3 node_rows node_columns"],
    own: Own,
    start: Float[Arrayish, "terms 3 node_rows node_columns"],
) -> tuple[Float[Array, "terms 3 node_rows node_columns"], Float[Array, "shots 5"]]:
    """The image and what is each shot's own, together.

    Args:
        windows: the data.
        spread: prior standard deviations of the image before it is smoothed.
        own: places and light, and how the data answer to them.
        start: such an image as is returned, before.

    Returns:
        (image in units of ``spread``, for ``image_of``; by how much each shot's own unknowns are changed now).
    """
    spread, flux, weight = jnp.asarray(spread), jnp.asarray(windows.flux), jnp.asarray(windows.weight)
    design = jnp.asarray(own.design)
    prior = jnp.array([_PLACE_SIGMA_PX] * 2 + [_LIGHT_SIGMA] * 3) ** -2.0
    inverse = jnp.linalg.inv(jnp.einsum("spyx,sqyx,syx->spq", design, design, weight) + jnp.diag(prior))

    def own_of(light: Float[Array, "shots rows columns"]) -> Float[Array, "shots 5"]:
        return jnp.einsum("spq,sqyx,syx->sp", inverse, design, weight * light)

    def weigh(light: Float[Array, "shots rows columns"]) -> Float[Array, "shots rows columns"]:
        return weight * (light - jnp.einsum("spyx,sp->syx", design, own_of(light)))

    def forward(scaled: Float[Array, "terms 3 node_rows node_columns"]) -> Float[Array, "shots rows columns"]:
        return flux * predict(windows, image_of(scaled, spread))

    # As if nothing had been changed yet: the model is linear, and the prior is about the whole change.
    data = jnp.asarray(windows.rate) + jnp.einsum("spyx,sp->syx", design, jnp.asarray(own.changed))
    before = jnp.asarray(start)
    # The prior is about what is added. About the whole, it would trade a smaller image for brighter LEDs.
    scaled = before + ridge(forward, weigh, data - forward(before), spread, _ITERATIONS, _TOLERANCE)
    return scaled, own_of(data - forward(scaled))


def image_of(
    scaled: Float[Arrayish, "terms 3 node_rows node_columns"], spread: Float[Arrayish, "terms 3 node_rows node_columns"]
) -> Float[Array, "terms 3 node_rows node_columns"]:
    """The image: what has the prior's standard deviations, smoothed by a Gaussian along both axes."""
    image = jnp.asarray(scaled) * spread
    reach = int(np.ceil(4 * _SMOOTH_NODES))
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / _SMOOTH_NODES) ** 2)
    weights /= weights.sum()
    planes = image.reshape(-1, 1, *image.shape[-2:])
    for axis in (0, 1):
        taps = jnp.asarray(np.expand_dims(weights, 1 - axis))[None, None]
        around = [(reach, reach) if a == axis else (0, 0) for a in (0, 1)]
        planes = jax.lax.conv_general_dilated(planes, taps, (1, 1), around)
    return planes.reshape(image.shape)


def on_pixels(
    image: Float[np.ndarray, "terms 3 node_rows node_columns"],
) -> Float[np.ndarray, "terms 3 rows columns"]:
    """The nodes of an image that lie on pixels."""
    return image[..., ::PER_PX, ::PER_PX]
