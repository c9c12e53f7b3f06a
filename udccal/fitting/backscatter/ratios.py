"""Light of pictures over that of white at sensor positions, and its slopes by the parameters.

Only the emitters' shares depend on where the footprints lie, and only the light of the panel on gamma. The shares and
their slopes come from the model by automatic differentiation, compiled once for a block of positions; the sums over
panel pixels, which are the bulk of the work, are matrix products.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy import sparse

from udccal.fitting.backscatter.blocks import in_blocks
from udccal.fitting.backscatter.evidence import Pictures
from udccal.fitting.backscatter.vector import NAMES, PLACES, mix_and_slopes, with_vector
from udccal.models.arrays import Arrayish
from udccal.models.backscatter import Backscatter, emitter_shares
from udccal.numerics import in_float64

_LEAST_WHITE = 1e-9
# Stands for the light of what lies beyond the crop.
_NOTHING = -1e3


@dataclass(frozen=True)
class Windows:
    """The panel pixels around each position's footprints.

    Attributes:
        rays: of the positions, in panel coordinates.
        corner: (column, row) of each window's first panel pixel.
        places: indices of a window's pixels in a row-major crop; ``inside`` tells which of them lie in it.
    """

    rays: Float[np.ndarray, "n 3"]
    corner: Int[np.ndarray, "n 2"]
    places: Int[np.ndarray, "n window2"]
    inside: Bool[np.ndarray, "n window2"]


def windows_at(window: int, rays: Float[np.ndarray, "n 3"], corner: Int[np.ndarray, "n 2"], shown: Pictures) -> Windows:
    """Windows of ``window`` x ``window`` pixels from these corners on."""
    crop, span = shown.crop, np.arange(window)
    columns = corner[:, 0, None, None] - crop.column + span[None, None, :]
    rows = corner[:, 1, None, None] - crop.row + span[None, :, None]
    inside = (columns >= 0) & (columns < crop.columns) & (rows >= 0) & (rows < crop.rows)
    flat = np.clip(rows, 0, crop.rows - 1) * crop.columns + np.clip(columns, 0, crop.columns - 1)
    return Windows(rays, corner, flat.reshape(len(corner), -1), inside.reshape(len(corner), -1))


@in_float64
def shares_at(
    template: Backscatter, x: Float[np.ndarray, "18"], rays: Float[np.ndarray, "n 3"], corner: Int[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n window2 3"]:
    """Share of every emitter in the windows from these corners on."""
    (shares,) = in_blocks(lambda rays, corner: (_shares(template, x, rays, corner),), rays, corner)
    return np.asarray(shares)


@jax.jit
def _shares(
    template: Backscatter, x: Float[Arrayish, "18"], rays: Float[Arrayish, "b 3"], corner: Int[Arrayish, "b 2"]
) -> Float[Array, "b window2 3"]:
    return emitter_shares(with_vector(template, jnp.asarray(x)), rays, corner)


@jax.jit
def _shares_and_slopes(
    template: Backscatter, x: Float[Arrayish, "18"], rays: Float[Arrayish, "b 3"], corner: Int[Arrayish, "b 2"]
) -> Float[Array, "b 3 window2 places_1"]:
    """Shares, and after them their slopes by the parameters of ``PLACES``."""
    whole = jnp.asarray(x)

    def shares_of(part: Array) -> Array:
        return emitter_shares(with_vector(template, whole.at[PLACES].set(part)), rays, corner)

    shares, slopes = shares_of(whole[PLACES]), jax.jacfwd(shares_of)(whole[PLACES])
    return jnp.moveaxis(jnp.concatenate([shares[..., None], slopes], axis=-1), 2, 1)


def ratios(
    template: Backscatter, x: Float[np.ndarray, "18"], at: Windows, shown: Pictures
) -> Float[np.ndarray, "pictures 3 n"]:
    """Light of pictures over that of white."""
    light, white = primary_light(shares_at(template, x, at.rays, at.corner), float(x[0]), at, shown)
    return mixed_ratios(light, white, mix_and_slopes(x)[0])


def primary_light(
    shares: Float[np.ndarray, "n window2 3"], gamma: float, at: Windows, shown: Pictures
) -> tuple[Float[np.ndarray, "pictures n 3"], Float[np.ndarray, "n 3"]]:
    """Light of each primary for pictures, and for white; nothing comes from beyond the crop."""
    panel, shares = np.exp(gamma * shown.logs), shares * at.inside[..., None]
    count, window2 = at.places.shape
    row_ends = np.arange(count + 1) * window2
    light = np.empty((len(panel), count, 3))
    for primary in range(3):
        every = (shares[:, :, primary].ravel(), at.places.ravel(), row_ends)
        collect = sparse.csr_array(every, shape=(count, panel.shape[1]))
        light[..., primary] = (collect @ np.ascontiguousarray(panel[..., primary].T)).T
    return light, shares.sum(axis=1)


def mixed_ratios(
    light: Float[np.ndarray, "pictures n 3"], white: Float[np.ndarray, "n 3"], mix: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "pictures 3 n"]:
    """Camera colours of primaries over those of white."""
    return np.asarray(np.moveaxis((light @ mix.T) / np.maximum(white @ mix.T, _LEAST_WHITE), 1, 2))


def window_logs(at: Windows, shown: Pictures) -> Float[np.ndarray, "n 3 pictures window2"]:
    """Logarithms of the picture values in each position's window, which no step of a fit changes."""
    logs = np.where(at.inside[None, ..., None], shown.logs[:, at.places], _NOTHING)
    return np.ascontiguousarray(np.transpose(logs, (1, 3, 0, 2)))


@in_float64
def ratios_and_slopes(
    template: Backscatter,
    x: Float[np.ndarray, "18"],
    at: Windows,
    logs: Float[np.ndarray, "n 3 pictures window2"],
) -> tuple[Float[np.ndarray, "pictures 3 n"], Float[np.ndarray, "18 pictures 3 n"]]:
    """Light of pictures over that of white, and its slopes; ``logs`` is of ``window_logs``."""
    (shares,) = in_blocks(lambda rays, corner: (_shares_and_slopes(template, x, rays, corner),), at.rays, at.corner)
    shares = shares * at.inside[:, None, :, None]
    panel = np.exp(x[0] * logs)
    # Position, primary, picture, (value and slopes).
    light = panel @ shares
    by_gamma = ((panel * logs) @ shares[..., :1])[..., 0]
    white = shares.sum(axis=2)
    mix, mix_slopes = mix_and_slopes(x)
    below = np.maximum(white[..., 0] @ mix.T, _LEAST_WHITE).T
    ratio = np.einsum("cp,npi->icn", mix, light[..., 0]) / below
    slope = np.empty((len(NAMES), *ratio.shape))
    slope[0] = np.einsum("cp,npi->icn", mix, by_gamma) / below
    over = np.einsum("cp,npik->kicn", mix, light[..., 1:])
    slope[PLACES] = (over - ratio * np.einsum("cp,npk->kcn", mix, white[..., 1:])[:, None]) / below
    over = np.einsum("kcp,npi->kicn", mix_slopes, light[..., 0])
    slope[PLACES.stop :] = (over - ratio * np.einsum("kcp,np->kcn", mix_slopes, white[..., 0])[:, None]) / below
    return ratio, slope
