"""Light of pictures over that of white at sensor positions, and its derivatives by the parameters.

Only the emitters' shares depend on where the footprints lie, and only the light of the panel on gamma. The shares and
their derivatives come from the model by automatic differentiation, compiled once for a block of positions; the sums
over panel pixels, which are the bulk of the work, are matrix products. ``theta`` is of ``parameters.linear_of``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped, UInt8
from scipy import sparse

from udccal.fitting.backscatter.parameters import EMITTERS, MIX, PLACES, SOFTNESS, Vector, mix_and_jacobian, with_linear
from udccal.models.arrays import Arrayish
from udccal.models.backscatter import Backscatter, emitter_shares, footprints, window_corners
from udccal.models.geometry import Geometry, panel_directions
from udccal.numerics import in_float64

BLOCK = 32
_LEAST_WHITE = 1e-9
# exp(gamma times this) is nothing.
_LOG_OF_BLACK = -1e3


def in_blocks(
    function: Callable[..., tuple[Array, ...]], *columns: Shaped[np.ndarray, "n ..."]
) -> tuple[Shaped[np.ndarray, "n ..."], ...]:
    """``function`` of arrays with one row per position, ``BLOCK`` rows at a time: it is compiled once.

    Args:
        function: takes as many arrays as there are ``columns``, BLOCK rows each; returns arrays of BLOCK rows.
        columns: arrays with the same number of rows, 1 or more; the last block repeats the last row.

    Returns:
        the function's arrays, with as many rows as the columns.
    """
    count = len(columns[0])
    found = []
    for first in range(0, count, BLOCK):
        rows = np.minimum(np.arange(first, first + BLOCK), count - 1)
        found.append([np.asarray(part) for part in function(*(column[rows] for column in columns))])
    return tuple(np.concatenate(parts)[:count] for parts in zip(*found, strict=True))


@in_float64
def directions(geometry: Geometry, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    """Rays of sensor pixels in panel coordinates."""
    (rays,) = in_blocks(lambda part: (_directions(geometry, part),), np.asarray(pixels, dtype=np.float64))
    return np.asarray(rays)


_directions = jax.jit(panel_directions)


def corners_of(template: Backscatter, theta: Vector, rays: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, "n 2"]:
    """(column, row) of the first panel pixel of each position's window."""
    return _middle_and_reach(template, theta, rays)[0] - (template.window - 1) // 2


def window_for(template: Backscatter, theta: Vector, rays: Float[np.ndarray, "n 3"], slack: float) -> int:
    """Odd number of panel pixels across a window that holds both footprints at every position."""
    reach_px = _middle_and_reach(template, theta, rays)[1]
    emitters = np.insert(theta[EMITTERS].reshape(2, 2), 1, 0.0, axis=0)
    spread = np.abs(emitters - emitters.mean(axis=0)).max()
    return 2 * int(np.ceil(reach_px.max() + spread + 4 * float(np.exp(theta[SOFTNESS])) + slack)) + 1


def with_room(
    template: Backscatter, theta: Vector, rays: Float[np.ndarray, "n 3"], slack: float, most: float
) -> Backscatter:
    """The template with a window that holds the footprints and lets them move, never smaller than it was.

    It stays where it would have to be more than ``most`` times as wide: such a fit has gone astray.
    """
    if not template.window < window_for(template, theta, rays, 0.0) <= most * template.window:
        return template
    return replace(template, window=window_for(template, theta, rays, slack))


@in_float64
def _middle_and_reach(
    template: Backscatter, theta: Vector, rays: Float[np.ndarray, "n 3"]
) -> tuple[Int[np.ndarray, "n 2"], Float[np.ndarray, " n"]]:
    """Middle panel pixel of each position's window, and how far the footprints reach from it."""
    # For a window of one pixel: windows of any size then share one compilation.
    single = replace(template, window=1)
    middle, reach = in_blocks(lambda part: _middle_and_reach_of_block(single, theta, part), rays)
    return middle.astype(np.int64), reach


@jax.jit
def _middle_and_reach_of_block(
    template: Backscatter, theta: Float[Arrayish, "18"], rays: Float[Arrayish, "b 3"]
) -> tuple[Int[Array, "b 2"], Float[Array, " b"]]:
    term = with_linear(template, jnp.asarray(theta))
    near, shape = footprints(term, rays, term.standoff_mm)
    far, far_shape = footprints(term, rays, term.standoff_mm + term.reflection_mm)
    extent = jnp.maximum(jnp.linalg.norm(shape, axis=2), jnp.linalg.norm(far_shape, axis=2)).max(axis=1)
    return window_corners(term, rays), extent + jnp.abs(far - near).max(axis=1) / 2


@final
@dataclass(frozen=True)
class PanelCrop:
    """The part of the panel that the camera can see: its first pixel and its size."""

    column: int
    row: int
    columns: int
    rows: int

    def of(self, picture: UInt8[np.ndarray, "panel_rows panel_columns 3"]) -> UInt8[np.ndarray, "rows columns 3"]:
        """That part of a picture."""
        return picture[self.row : self.row + self.rows, self.column : self.column + self.columns].copy()


@final
@dataclass(frozen=True)
class Pictures:
    """What the panel showed in the part that the camera sees: logarithms of its values over 255."""

    logs: Float[np.ndarray, "pictures pixels 3"]
    crop: PanelCrop

    @classmethod
    def of(cls, shown: UInt8[np.ndarray, "pictures crop_rows crop_columns 3"], crop: PanelCrop) -> Pictures:
        """From values of 0 to 255."""
        values = shown.reshape(len(shown), crop.rows * crop.columns, 3) / 255.0
        return cls(np.where(values > 0, np.log(np.maximum(values, 1e-9)), _LOG_OF_BLACK), crop)


@final
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

    @classmethod
    def at(
        cls, window: int, rays: Float[np.ndarray, "n 3"], corner: Int[np.ndarray, "n 2"], shown: Pictures
    ) -> Windows:
        """Of ``window`` x ``window`` pixels from these corners on."""
        crop, span = shown.crop, np.arange(window)
        columns = corner[:, 0, None, None] - crop.column + span[None, None, :]
        rows = corner[:, 1, None, None] - crop.row + span[None, :, None]
        inside = (columns >= 0) & (columns < crop.columns) & (rows >= 0) & (rows < crop.rows)
        flat = np.clip(rows, 0, crop.rows - 1) * crop.columns + np.clip(columns, 0, crop.columns - 1)
        return cls(rays, corner, flat.reshape(len(corner), -1), inside.reshape(len(corner), -1))

    def logs(self, shown: Pictures) -> Float[np.ndarray, "n 3 pictures window2"]:
        """Logarithms of the picture values in each window; nothing comes from beyond the crop."""
        logs = np.where(self.inside[None, ..., None], shown.logs[:, self.places], _LOG_OF_BLACK)
        return np.ascontiguousarray(np.transpose(logs, (1, 3, 0, 2)))


@in_float64
def shares_at(
    template: Backscatter,
    theta: Vector,
    rays: Float[np.ndarray, "n 3"],
    corner: Int[np.ndarray, "n 2"],
) -> Float[np.ndarray, "n window2 3"]:
    """Share of every emitter in the windows from these corners on."""
    (shares,) = in_blocks(lambda rays, corner: (_shares(template, theta, rays, corner),), rays, corner)
    return np.asarray(shares)


@jax.jit
def _shares(
    template: Backscatter, theta: Float[Arrayish, "18"], rays: Float[Arrayish, "b 3"], corner: Int[Arrayish, "b 2"]
) -> Float[Array, "b window2 3"]:
    return emitter_shares(with_linear(template, jnp.asarray(theta)), rays, corner)


@jax.jit
def _shares_and_jacobian(
    template: Backscatter, theta: Float[Arrayish, "18"], rays: Float[Arrayish, "b 3"], corner: Int[Arrayish, "b 2"]
) -> Float[Array, "b 3 window2 places_1"]:
    """Shares, and after them their derivatives by the parameters of ``PLACES``."""
    whole = jnp.asarray(theta)

    def shares_of(part: Array) -> Array:
        return emitter_shares(with_linear(template, whole.at[PLACES].set(part)), rays, corner)

    shares, by_place = shares_of(whole[PLACES]), jax.jacfwd(shares_of)(whole[PLACES])
    return jnp.moveaxis(jnp.concatenate([shares[..., None], by_place], axis=-1), 2, 1)


def ratios(template: Backscatter, theta: Vector, at: Windows, shown: Pictures) -> Float[np.ndarray, "pictures 3 n"]:
    """Light of pictures over that of white."""
    shares = shares_at(template, theta, at.rays, at.corner)
    return mixed_ratios(*primary_light(shares, float(theta[0]), at, shown), mix_and_jacobian(theta)[0])


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


@in_float64
def ratios_and_jacobian(
    template: Backscatter, theta: Vector, at: Windows, logs: Float[np.ndarray, "n 3 pictures window2"]
) -> tuple[Float[np.ndarray, "pictures 3 n"], Float[np.ndarray, "18 pictures 3 n"]]:
    """Light of pictures over that of white, and its derivatives; ``logs`` is of ``Windows.logs``."""
    (shares,) = in_blocks(
        lambda rays, corner: (_shares_and_jacobian(template, theta, rays, corner),), at.rays, at.corner
    )
    shares = shares * at.inside[:, None, :, None]
    panel = np.exp(theta[0] * logs)
    # Position, primary, picture, (value and derivatives).
    light = panel @ shares
    by_gamma = ((panel * logs) @ shares[..., :1])[..., 0]
    white = shares.sum(axis=2)
    mix, by_mix = mix_and_jacobian(theta)
    below = np.maximum(white[..., 0] @ mix.T, _LEAST_WHITE).T
    ratio = np.einsum("cp,npi->icn", mix, light[..., 0]) / below
    jacobian = np.empty((len(theta), *ratio.shape))
    jacobian[0] = np.einsum("cp,npi->icn", mix, by_gamma) / below
    over = np.einsum("cp,npik->kicn", mix, light[..., 1:])
    jacobian[PLACES] = (over - ratio * np.einsum("cp,npk->kcn", mix, white[..., 1:])[:, None]) / below
    over = np.einsum("kcp,npi->kicn", by_mix, light[..., 0])
    jacobian[MIX] = (over - ratio * np.einsum("kcp,np->kcn", by_mix, white[..., 0])[:, None]) / below
    return ratio, jacobian


@in_float64
def best_offset(
    template: Backscatter,
    theta: Vector,
    rays: Float[np.ndarray, "n 3"],
    shown: Pictures,
    ratio: Float[np.ndarray, "pictures 3 n"],
    weight: Float[np.ndarray, "pictures 3 n"],
    reach_px: Float[np.ndarray, "2"],
) -> tuple[int, int]:
    """Panel offset (x, y) at which a free mix of primaries explains measured ratios best: where a fit may start.

    Offsets are whole panel pixels: a window that moves with them sees the same shares of its emitters.
    """
    corner = corners_of(template, theta, rays)
    shares = shares_at(template, theta, rays, corner)

    def cost(offset: tuple[int, int]) -> float:
        moved = Windows.at(template.window, rays, corner - np.array(offset), shown)
        primaries, total = mixed_ratios(*primary_light(shares, float(theta[0]), moved, shown), np.eye(3)), 0.0
        for channel in range(3):
            every = weight[:, channel].ravel()
            design = np.moveaxis(primaries, 1, -1).reshape(-1, 3) * every[:, None]
            wanted = ratio[:, channel].ravel() * every
            mix = np.linalg.lstsq(design, wanted, rcond=None)[0]
            total += float(((design @ mix - wanted) ** 2).sum())
        return total

    across, down = (range(-int(np.ceil(reach)), int(np.ceil(reach)) + 1) for reach in reach_px)
    return min(((x, y) for y in down for x in across), key=cost)
