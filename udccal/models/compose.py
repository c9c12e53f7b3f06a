"""The five terms together: y = [(x * k) + b] w + n, as expected signal and variance of every sample of a mosaic.

This is the direct form of the camera model. Tests compare with it, and fits that need the whole model use it.
Restoration inverts a low-rank form of the same operator.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from udccal.models.arrays import Arrayish
from udccal.models.noise import Noise, variance_e


def space_varying_blur(
    scene: Float[Arrayish, "rows columns 3"],
    kernels: Float[Arrayish, "n 3 kernel_rows kernel_columns"],
    weights: Float[Arrayish, "n rows columns"],
) -> Float[Array, "rows columns 3"]:
    """Blur a scene: y = sum_n k_n * (weights_n x). Kernels belong to the source point; light beyond the edges is lost.

    Args:
        scene: linear light of each camera colour.
        kernels: one per field position, of odd size, origin in the middle.
        weights: weight of each kernel at each source pixel; they sum to 1 over n.
    """
    scene, kernels, weights = jnp.asarray(scene), jnp.asarray(kernels), jnp.asarray(weights)
    rows, columns = scene.shape[:2]
    ky, kx = kernels.shape[2:]
    shape = (rows + ky - 1, columns + kx - 1)

    def add(total: Array, item: tuple[Array, Array]) -> tuple[Array, None]:
        kernel, weight = item
        source = jnp.fft.rfft2(jnp.moveaxis(scene * weight[..., None], -1, 0), s=shape)
        return total + source * jnp.fft.rfft2(kernel, s=shape), None

    start = jnp.zeros((3, shape[0], shape[1] // 2 + 1), dtype=jnp.result_type(scene, 1j))
    spectrum, _ = jax.lax.scan(add, start, (kernels, weights))
    picture = jnp.fft.irfft2(spectrum, s=shape)[:, ky // 2 : ky // 2 + rows, kx // 2 : kx // 2 + columns]
    return jnp.moveaxis(picture, 0, -1)


def bilinear_weights(
    x_px: Float[Arrayish, " nx"], y_px: Float[Arrayish, " ny"], rows: int, columns: int
) -> Float[Array, "n rows columns"]:
    """Return weights that interpolate bilinearly between kernels at a grid of positions; constant beyond the grid.

    Args:
        x_px: x of the grid's columns. y_px: y of the grid's rows.
        rows: rows of the sensor. columns: columns of the sensor.

    Returns:
        one map per position of the grid, in row-major order.
    """
    down = _hats(jnp.asarray(y_px), jnp.arange(rows))
    across = _hats(jnp.asarray(x_px), jnp.arange(columns))
    return (down[:, None, :, None] * across[None, :, None, :]).reshape(-1, rows, columns)


def _hats(nodes: Float[Array, " n"], at: Int[Array, " m"]) -> Float[Array, "n m"]:
    """Return each node's piecewise linear weight at each place."""
    identity = jnp.eye(nodes.shape[0], dtype=nodes.dtype)
    return jax.vmap(lambda row: jnp.interp(at.astype(nodes.dtype), nodes, row))(identity)


def mosaic_rate(
    blurred: Float[Arrayish, "rows columns 3"],
    backscatter: Float[Arrayish, "rows columns"],
    wire: Float[Arrayish, "rows columns"],
    channels: Int[Arrayish, "rows columns"],
) -> Float[Array, "rows columns"]:
    """Return [(x * k) + b] w at every sample of the mosaic, in e-/s.

    Args:
        blurred: x * k in e-/s by camera colour.
        backscatter: b in e-/s.
        wire: w, with mean 1.
        channels: colour of each sample: 0 = R, 1 = G, 2 = B.
    """
    index = jnp.asarray(channels)[..., None]
    sampled = jnp.take_along_axis(jnp.asarray(blurred), index, axis=-1)[..., 0]
    return (sampled + jnp.asarray(backscatter)) * jnp.asarray(wire)


def expected_frame(
    noise: Noise, rate: Float[Arrayish, "rows columns"], exposure_s: Float[Arrayish, ""]
) -> tuple[Float[Array, "rows columns"], Float[Array, "rows columns"]]:
    """Return the mean in DN and the variance in DN^2 of every sample of a frame, clipping left out (EMVA 1288).

    Args:
        noise: the noise term.
        rate: photo-electrons in e-/s.
        exposure_s: exposure time.
    """
    signal = jnp.asarray(rate) * exposure_s
    linear_DN = noise.K_DN_per_e * (signal + noise.dark_current_e_per_s * exposure_s)
    mean = jnp.asarray(noise.black_DN) + linear_DN * (1 - noise.bend_per_DN * linear_DN)
    return mean, jnp.asarray(noise.K_DN_per_e) ** 2 * variance_e(noise, signal, exposure_s)
