"""Light of pictures over that of white at sensor positions, and its derivatives by the parameters.

Only the emitters' shares depend on the places of the footprints, and only the panel's light depends on gamma. Automatic
differentiation of the model gives the derivatives of the shares, compiled once for a block of positions. Sums over
panel pixels are products of sparse matrices. White is the first shot, the dark frame the last.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped, UInt8
from scipy import sparse

from udccal.fitting.backscatter.parameters import EMITTERS, MIX, OFF_DIAGONAL, PLACES, SOFTNESS, Vector, with_linear
from udccal.models.arrays import Arrayish
from udccal.models.backscatter import Backscatter, emitter_shares, footprints, window_corners
from udccal.models.geometry import Geometry, panel_directions
from udccal.numerics import in_float64

# Axes: shot, colour, position; bin: colour, position; Moves add the parameter. Rays are in panel coordinates.
PerShot = Float[np.ndarray, "shots 3 n"]
PerBin = Float[np.ndarray, "3 n"]
Usable = Bool[np.ndarray, "shots 3 n"]
Rays = Float[np.ndarray, "n 3"]
Moves = Float[np.ndarray, "k shots 3 n"]
BLOCK = 32
_LEAST_WHITE = 1e-9


def in_blocks(
    function: Callable[..., tuple[Array, ...]], *columns: Shaped[np.ndarray, "n ..."]
) -> tuple[Shaped[np.ndarray, "n ..."], ...]:
    """Apply a function to arrays with one row per position, ``BLOCK`` rows at a time: it is compiled once."""
    count = len(columns[0])
    found = []
    for first in range(0, count, BLOCK):
        # The last block repeats the last row.
        rows = np.minimum(np.arange(first, first + BLOCK), count - 1)
        found.append([np.asarray(part) for part in function(*(column[rows] for column in columns))])
    return tuple(np.concatenate(parts)[:count] for parts in zip(*found, strict=True))


_directions = jax.jit(panel_directions)


@in_float64
def directions(geometry: Geometry, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    """Return the rays of sensor pixels in panel coordinates."""
    return in_blocks(lambda part: (_directions(geometry, part),), np.asarray(pixels, dtype=np.float64))[0]


def corners_of(template: Backscatter, theta: Vector, rays: Rays) -> Int[np.ndarray, "n 2"]:
    """Return (column, row) of the first panel pixel of each position's window."""
    return _middle_and_reach(template, theta, rays)[0] - (template.window - 1) // 2


def window_for(template: Backscatter, theta: Vector, rays: Rays, slack: float) -> int:
    """Return the odd number of panel pixels across a window that holds both footprints at every position.

    Args:
        template: gives the geometry.
        theta: of ``parameters.linear_of``.
        rays: in panel coordinates.
        slack: distance that the footprints may move, in panel px.
    """
    reach_px = _middle_and_reach(template, theta, rays)[1]
    emitters = np.insert(theta[EMITTERS].reshape(2, 2), 1, 0.0, axis=0)
    spread = np.abs(emitters - emitters.mean(axis=0)).max()
    return 2 * int(np.ceil(reach_px.max() + spread + 4 * float(np.exp(theta[SOFTNESS])) + slack)) + 1


@in_float64
def _middle_and_reach(
    template: Backscatter, theta: Vector, rays: Rays
) -> tuple[Int[np.ndarray, "n 2"], Float[np.ndarray, " n"]]:
    """Return the middle panel pixel of each position's window, and the footprints' reach from it in panel px."""
    # With a window of one pixel, windows of any size use one compilation.
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
        """Return that part of a picture."""
        return picture[self.row : self.row + self.rows, self.column : self.column + self.columns].copy()


@final
@dataclass(frozen=True)
class Pictures:
    """The pictures in the part of the panel that the camera sees: white first, and black last.

    Values are 0 to 255 by primary. Pixels of the crop are row by row; a black one follows for all beyond the crop.
    """

    values: UInt8[np.ndarray, "3 pixels shots"]
    crop: PanelCrop

    @classmethod
    def of(cls, shown: UInt8[np.ndarray, "pictures crop_rows crop_columns 3"], crop: PanelCrop) -> Pictures:
        """Add white and black to pictures in the crop with values 0 to 255."""
        values = shown.reshape(len(shown), crop.rows * crop.columns, 3).transpose(2, 1, 0)
        white = np.full((3, values.shape[1], 1), 255, np.uint8)
        return cls(np.pad(np.concatenate([white, values], axis=2), ((0, 0), (0, 1), (0, 1))), crop)

    def light(self, gamma: float) -> Float[np.ndarray, "2 3 pixels shots"]:
        """Return the light of the panel's primaries, 1 at most, and its derivative by gamma."""
        log = np.log(np.maximum(np.arange(256), 1) / 255)
        light = np.where(np.arange(256) > 0, np.exp(gamma * log), 0.0)
        return np.stack([light, light * log])[:, self.values]


@final
@dataclass(frozen=True)
class Windows:
    """The panel pixels around each position's footprints.

    Attributes:
        rays: of the positions, in panel coordinates.
        corner: (column, row) of each window's first panel pixel.
        places: indices of a window's pixels among those of ``Pictures``.
    """

    rays: Rays
    corner: Int[np.ndarray, "n 2"]
    places: Int[np.ndarray, "n window2"]

    @classmethod
    def around(cls, template: Backscatter, theta: Vector, rays: Rays, crop: PanelCrop) -> Windows:
        """Return windows of the template's width around the footprints of these parameters."""
        corner, span = corners_of(template, theta, rays), np.arange(template.window)
        columns = corner[:, 0, None, None] - crop.column + span[None, None, :]
        rows = corner[:, 1, None, None] - crop.row + span[None, :, None]
        inside = (columns >= 0) & (columns < crop.columns) & (rows >= 0) & (rows < crop.rows)
        places = np.where(inside, rows * crop.columns + columns, crop.rows * crop.columns)
        return cls(rays, corner, places.reshape(len(corner), -1))

    def sums(
        self, shares: Float[np.ndarray, "n 3 k window2"], panel: Float[np.ndarray, "3 pixels shots"]
    ) -> Float[np.ndarray, "k 3 shots n"]:
        """Sum each primary's light over the windows; panel pixels beyond the crop are black."""
        pixels = panel.shape[1]
        places = self.places[:, None, None] + pixels * np.arange(3)[:, None, None]
        columns = np.broadcast_to(places, shares.shape).ravel()
        ends = np.arange(0, shares.size + 1, shares.shape[3])
        collect = sparse.csr_array((shares.ravel(), columns, ends), shape=(len(ends) - 1, 3 * pixels))
        light = (collect @ panel.reshape(3 * pixels, -1)).reshape(*shares.shape[:3], -1)
        return light.transpose(2, 1, 3, 0)


@in_float64
def _shares_at(
    template: Backscatter, theta: Vector, at: Windows, derivatives: bool
) -> Float[np.ndarray, "n 3 k window2"]:
    """Return the share of every emitter in the windows, and on request its derivatives by ``PLACES``."""
    of_block = functools.partial(_shares, template, theta, derivatives=derivatives)
    (shares,) = in_blocks(lambda rays, corner: (of_block(rays, corner),), at.rays, at.corner)
    return shares


@functools.partial(jax.jit, static_argnames="derivatives")
def _shares(
    template: Backscatter,
    theta: Float[Arrayish, "18"],
    rays: Float[Arrayish, "b 3"],
    corner: Int[Arrayish, "b 2"],
    derivatives: bool,
) -> Float[Array, "b 3 k window2"]:
    whole = jnp.asarray(theta)

    def shares_of(part: Array) -> Array:
        return emitter_shares(with_linear(template, whole.at[PLACES].set(part)), rays, corner)

    found = shares_of(whole[PLACES])[..., None]
    if derivatives:
        found = jnp.concatenate([found, jax.jacfwd(shares_of)(whole[PLACES])], axis=-1)
    return jnp.transpose(found, (0, 2, 3, 1))


def ratios(template: Backscatter, theta: Vector, at: Windows, shown: Pictures) -> PerShot:
    """Return the light of pictures over that of white, by shot, colour and position."""
    shares = _shares_at(template, theta, at, derivatives=False)
    light = _mixed(theta, at.sums(shares, shown.light(float(theta[0]))[0]))[0]
    return light / np.maximum(light[0], _LEAST_WHITE)


def ratios_and_jacobian(template: Backscatter, theta: Vector, at: Windows, shown: Pictures) -> tuple[PerShot, Moves]:
    """Return ``ratios``, by shot, colour and position, and their derivatives by each of ``theta``.

    Args:
        template, theta: geometry and window; parameters of ``parameters.linear_of``.
        at, shown: the panel pixels around the footprints; what the panel showed.
    """
    shares = _shares_at(template, theta, at, derivatives=True)
    panel, by_gamma = shown.light(float(theta[0]))
    primaries = at.sums(shares, panel)
    light = _mixed(theta, primaries)
    white = np.maximum(light[0, 0], _LEAST_WHITE)
    ratio = light[0] / white
    jacobian = np.zeros((len(theta), *ratio.shape))
    jacobian[0] = _mixed(theta, at.sums(shares[:, :, :1], by_gamma))[0] / white
    jacobian[PLACES] = (light[1:] - ratio * light[1:, :1]) / white
    for k, (colour, primary) in enumerate(zip(*OFF_DIAGONAL, strict=True), MIX.start):
        one = primaries[0, primary]
        jacobian[k, :, colour] = (one - ratio[:, colour] * one[0]) / white[colour]
    return ratio, jacobian


def _mixed(theta: Vector, primaries: Float[np.ndarray, "k 3 shots n"]) -> Moves:
    """Mix primaries into camera colours, except for a factor per colour, which cancels in ratios."""
    mix = np.eye(3)
    mix[OFF_DIAGONAL] = theta[MIX]
    return np.einsum("cp,kpsn->kscn", mix, primaries)


@final
@dataclass(frozen=True)
class Profile:
    """The most probable mask and dark signal for given ratios, bin by bin.

    Attributes:
        mask, dark: e-/s.
        errors: measured less modelled rates; ``weight`` is 1 / sigma of each.
        information: on the mask, with the dark signal eliminated.
        by_mask, by_dark: orthonormal directions of the whitened errors that mask and dark remove.
    """

    mask: PerBin
    dark: PerBin
    errors: PerShot
    weight: PerShot
    information: PerBin
    by_mask: PerShot
    by_dark: PerShot

    @property
    def chi2(self) -> float:
        """Chi-squared without the prior."""
        return float(((self.errors * self.weight) ** 2).sum())

    @classmethod
    def of(cls, ratio: PerShot, light: PerShot, exposure: Float[np.ndarray, " shots"], weight: PerShot) -> Profile:
        """Solve for mask and dark from all shots' ratios and light; ``exposure`` is the dark frame's over theirs."""
        apart = exposure[:, None, None] * weight
        length = np.sqrt((apart**2).sum(axis=0))
        by_dark = apart / length
        across = ratio * weight - by_dark * (by_dark * ratio * weight).sum(axis=0)
        information = (across**2).sum(axis=0)
        root = np.sqrt(np.where(information > 0, information, 1.0))
        by_mask = across / root
        mask = (by_mask * light * weight).sum(axis=0) / root
        dark = (by_dark * (light - mask * ratio) * weight).sum(axis=0) / length
        errors = light - mask * ratio - exposure[:, None, None] * dark
        return cls(mask, dark, errors, weight, information, by_mask, by_dark)

    def jacobian(self, of_ratio: Moves) -> Moves:
        """Return the whitened errors' Jacobian without the parts that mask and dark remove (Kaufman, BIT 15, 1975)."""
        jacobian = -(self.mask * self.weight) * of_ratio
        for way in (self.by_dark, self.by_mask):
            jacobian -= way * np.einsum("scn,kscn->kcn", way, jacobian)[:, None]
        return jacobian

    def mask_jacobian(self, of_ratio: Moves) -> Float[np.ndarray, "k 3 n"]:
        """Return the mask's derivatives for the expected light; the contribution of noise is of second order."""
        along = np.einsum("scn,kscn->kcn", self.by_mask * self.weight, of_ratio)
        return -self.mask * along / np.sqrt(np.where(self.information > 0, self.information, 1.0))

    def light_variance(self, ratio: PerShot, of_ratio: Moves, cov: Float[np.ndarray, "k k"]) -> PerShot:
        """Return predicted light's variance: from the parameters and their effect on the mask, and from its noise."""
        moves = self.mask * of_ratio + ratio * self.mask_jacobian(of_ratio)[:, None]
        by_parameters = np.einsum("kicn,kl,licn->icn", moves, cov, moves, optimize=True)
        return np.asarray(by_parameters + ratio**2 / np.maximum(self.information, 1e-30))
