"""Backscatter: the light that the lit panel sends into the lens, as a function of the picture it shows.

Every panel pixel carries one small emitter per primary. A sensor pixel collects the emitters inside the pupil's
footprint on the panel. The footprint is the pupil projected along the pixel's ray: an ellipse a few panel pixels wide.
The panel is far out of focus, so the footprint hardly depends on where the lens is focused. The front face of the
glass reflects a second, fainter copy, which appears to come from a deeper plane. With L = (picture / 255)^gamma,

    b_c(q) = mask_c(q) sum_p C[c, p] S_p(q) / sum_p C[c, p] S_p(q; white),
    S_p(q) = sum over panel pixels of (fraction of emitter p inside the footprint of q) L_p.

``mask`` is the rate of an all-white panel in e-/s. The quotient is a low-pass of the panel's light, mixed from
primaries to camera colours. b is defined before multiplication by the wire: y = (x * k + b) w.
"""

from __future__ import annotations

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.special import erf
from jaxtyping import Array, Float, Int, Num

from udccal.cfa import cfa_named
from udccal.models.arrays import Arrayish
from udccal.models.geometry import Geometry, panel_directions, rotation_matrix


class Backscatter(eqx.Module):
    """Panel light in the lens.

    Attributes:
        geometry: camera geometry, which gives each pixel's ray.
        mask: rate of an all-white panel in e-/s, by camera colour, at the grid of ``grid_positions``.
        mix: matrix from primaries to camera colours; rows sum to 1.
        gamma: exponent of the panel's transfer curve.
        pitch_mm: distance of panel pixels.
        pupil_diameter_mm: diameter of the entrance pupil as the footprint shows it.
        standoff_mm: distance from the pupil to the plane of the emitters.
        emitters_px: (x, y) of each primary's emitter from the centre of its panel pixel, in panel pixels.
        softness_px: one sigma of the footprint's soft edge in panel pixels; it includes the size of an emitter.
        reflection: light of the reflected copy relative to the direct light.
        reflection_mm: additional depth at which the reflected copy appears.
        columns, rows, cfa: size and pattern of the sensor. step: spacing of the grid in sensor px.
        window: panel pixels across the square that holds the footprint.
    """

    geometry: Geometry
    mask: Float[Arrayish, "3 grid_rows grid_columns"]
    mix: Float[Arrayish, "3 3"]
    gamma: Float[Arrayish, ""]
    pitch_mm: Float[Arrayish, ""]
    pupil_diameter_mm: Float[Arrayish, ""]
    standoff_mm: Float[Arrayish, ""]
    emitters_px: Float[Arrayish, "3 2"]
    softness_px: Float[Arrayish, ""]
    reflection: Float[Arrayish, ""]
    reflection_mm: Float[Arrayish, ""]
    columns: int = eqx.field(static=True)
    rows: int = eqx.field(static=True)
    cfa: str = eqx.field(static=True)
    step: int = eqx.field(static=True)
    window: int = eqx.field(static=True)


class PanelResponse(eqx.Module):
    """A term evaluated for one panel size; ``response_rate`` applies it to any number of pictures.

    Attributes:
        term: the term.
        shares: fraction of each emitter that the footprint collects, per grid position, window pixel and primary.
        pixels: index of each window pixel in the row-major picture.
        gain: the term's mask divided by the mixed response to white, by camera colour.
    """

    term: Backscatter
    shares: Float[Arrayish, "positions window2 3"]
    pixels: Int[Arrayish, "positions window2"]
    gain: Float[Arrayish, "3 positions"]


def grid_positions(
    columns: int, rows: int, step: int
) -> tuple[Float[Array, " grid_columns"], Float[Array, " grid_rows"]]:
    """Sensor x and y of the grid: centres of whole blocks of ``step`` x ``step`` pixels from the top left."""
    x, y = (step * (jnp.arange(count // step) + 0.5) - 0.5 for count in (columns, rows))
    return x, y


def footprints(
    term: Backscatter, rays: Float[Arrayish, "n 3"], standoff_mm: Float[Arrayish, ""]
) -> tuple[Float[Array, "n 2"], Float[Array, "n 2 2"]]:
    """Project the pupil along rays onto a plane parallel to the panel.

    A pupil point lies at R_panel_camera (r u, 0) from the pupil's centre. A ray of slope t = (s_x, s_y) / s_z through
    it crosses the plane at P = pupil_xy + t standoff + (R_xy - t R_z) r u.

    Args:
        term: the backscatter term.
        rays: directions in panel coordinates.
        standoff_mm: distance of the plane from the pupil.

    Returns:
        (centre, shape) in panel pixels: the ellipse ``centre + shape @ u`` over the unit disc of u.
    """
    rays = jnp.asarray(rays)
    slopes = rays[:, :2] / rays[:, 2:]
    across = rotation_matrix(term.geometry.rotation_rad)[:, :2] * (term.pupil_diameter_mm / 2)
    centre = jnp.asarray(term.geometry.pupil_mm)[:2] + standoff_mm * slopes
    shape = across[:2] - slopes[:, :, None] * across[2]
    return centre / term.pitch_mm, shape / term.pitch_mm


def emitter_shares(
    term: Backscatter, rays: Float[Arrayish, "n 3"], corner: Int[Arrayish, "n 2"]
) -> Float[Array, "n window2 3"]:
    """Return the fraction of each emitter that the footprint collects, direct and reflected light together.

    Args:
        term: the backscatter term.
        rays: directions in panel coordinates.
        corner: (column, row) of the first panel pixel of each ray's window.

    Returns:
        fractions divided by the footprint's area in panel pixels, so that they sum to about 1 for each primary.
    """
    span = jnp.arange(term.window)
    inner = jnp.stack(jnp.meshgrid(span, span), axis=-1).reshape(-1, 2)
    places = jnp.asarray(corner)[:, None, None] + inner[None, :, None] + jnp.asarray(term.emitters_px)
    direct = _inside(term, places, *footprints(term, rays, term.standoff_mm))
    reflected = _inside(term, places, *footprints(term, rays, term.standoff_mm + term.reflection_mm))
    return (direct + term.reflection * reflected) / (1 + term.reflection)


def _inside(
    term: Backscatter,
    places: Float[Array, "n window2 3 2"],
    centre: Float[Array, "n 2"],
    shape: Float[Array, "n 2 2"],
) -> Float[Array, "n window2 3"]:
    """Soft indicator of the ellipse: the cumulative normal distribution of the first-order distance from its edge."""
    determinant = shape[:, 0, 0] * shape[:, 1, 1] - shape[:, 0, 1] * shape[:, 1, 0]
    rows = [[shape[:, 1, 1], -shape[:, 0, 1]], [-shape[:, 1, 0], shape[:, 0, 0]]]
    inverse = jnp.moveaxis(jnp.array(rows), 2, 0) / determinant[:, None, None]
    unit = jnp.einsum("nij,nwpj->nwpi", inverse, places - centre[:, None, None])
    radius = jnp.sqrt((unit**2).sum(-1) + 1e-6)
    slope = jnp.einsum("nij,nwpi->nwpj", inverse, unit) / radius[..., None]
    edge = (1 - radius) / jnp.sqrt((slope**2).sum(-1) + 1e-12)
    inside = 0.5 + 0.5 * erf(edge / (jnp.sqrt(2.0) * term.softness_px))
    return inside / (jnp.pi * jnp.abs(determinant))[:, None, None]


def window_corners(term: Backscatter, rays: Float[Arrayish, "n 3"]) -> Int[Array, "n 2"]:
    """Return (column, row) of the first panel pixel of the window around the footprints of ``rays`` (panel axes)."""
    centre, _ = footprints(term, rays, term.standoff_mm + term.reflection_mm * 0.5)
    middle = centre - jnp.asarray(term.emitters_px).mean(axis=0)
    return jnp.round(middle - (term.window - 1) / 2).astype(jnp.int32)


def panel_light(term: Backscatter, picture: Num[Arrayish, "*n 3"]) -> Float[Array, "*n 3"]:
    """Return the linear light of each primary, 0 to 1, for picture values from 0 to 255."""
    return (jnp.asarray(picture, dtype=float) / 255.0) ** term.gamma


def mixed_colours(term: Backscatter, primaries: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    """Mix primaries to camera colours, as a sum: jaxlib 0.10.2 miscompiles small matrix products over long arrays."""
    return (primaries[..., None, :] * jnp.asarray(term.mix)).sum(axis=-1)


@functools.partial(jax.jit, static_argnums=(1, 2))
def panel_response(term: Backscatter, panel_rows: int, panel_columns: int) -> PanelResponse:
    """Evaluate a term for a panel that is dark beyond its edges.

    Args:
        term: the backscatter term.
        panel_rows: rows of the panel. panel_columns: columns of the panel.
    """
    x, y = grid_positions(term.columns, term.rows, term.step)
    pixels = jnp.stack(jnp.meshgrid(x, y), axis=-1)

    def one_row(line: Float[Array, "n 2"]) -> tuple[Float[Array, "n window2 3"], Int[Array, "n window2"]]:
        rays = panel_directions(term.geometry, line)
        corner = window_corners(term, rays)
        return _on_panel(term, emitter_shares(term, rays, corner), corner, panel_rows, panel_columns)

    shares, places = jax.lax.map(one_row, pixels)
    shares = shares.reshape(-1, *shares.shape[2:])
    white = mixed_colours(term, shares.sum(axis=1)).T
    mask = jnp.asarray(term.mask).reshape(3, -1)
    gain = jnp.where(white > 1e-6, mask / jnp.maximum(white, 1e-6), 0.0)
    return PanelResponse(term, shares, places.reshape(-1, places.shape[-1]), gain)


def _on_panel(
    term: Backscatter,
    shares: Float[Array, "n window2 3"],
    corner: Int[Array, "n 2"],
    panel_rows: int,
    panel_columns: int,
) -> tuple[Float[Array, "n window2 3"], Int[Array, "n window2"]]:
    """Set shares beyond the panel's edges to 0, and return them with each pixel's index in a row-major picture."""
    span = jnp.arange(term.window)
    columns = corner[:, 0, None, None] + span[None, None, :]
    rows = corner[:, 1, None, None] + span[None, :, None]
    on_panel = (columns >= 0) & (columns < panel_columns) & (rows >= 0) & (rows < panel_rows)
    flat = jnp.clip(rows, 0, panel_rows - 1) * panel_columns + jnp.clip(columns, 0, panel_columns - 1)
    places = flat.reshape(len(flat), -1)
    return shares * on_panel.reshape(places.shape)[..., None], places


def response_grid(
    response: PanelResponse, picture: Num[Arrayish, "panel_rows panel_columns 3"]
) -> Float[Array, "3 grid_rows grid_columns"]:
    """Backscatter in e-/s by camera colour at the grid of ``grid_positions``."""
    term = response.term
    seen = jnp.asarray(picture).reshape(-1, 3)[response.pixels]
    gathered = (response.shares * panel_light(term, seen)).sum(axis=1)
    return (response.gain * mixed_colours(term, gathered).T).reshape(jnp.shape(term.mask))


@jax.jit
def response_rate(
    response: PanelResponse, picture: Num[Arrayish, "panel_rows panel_columns 3"]
) -> Float[Array, "rows columns"]:
    """Return the mosaic of backscatter in e-/s, before the wire.

    Args:
        response: the term evaluated by ``panel_response``.
        picture: what the panel shows, RGB values from 0 to 255.
    """
    return mosaic_of_grid(response.term, response_grid(response, picture))


@jax.jit
def backscatter_rate(
    term: Backscatter, picture: Num[Arrayish, "panel_rows panel_columns 3"]
) -> Float[Array, "rows columns"]:
    """Return the mosaic of backscatter in e-/s, before the wire; for several pictures keep one ``panel_response``.

    Args:
        term: the backscatter term.
        picture: what the panel shows, RGB values from 0 to 255.
    """
    panel_rows, panel_columns = jnp.shape(picture)[:2]
    return response_rate(panel_response(term, panel_rows, panel_columns), picture)


@jax.jit
def typical_rate(term: Backscatter, level: Float[Arrayish, ""]) -> Float[Array, "rows columns"]:
    """Mosaic in e-/s for a panel showing an even grey of ``level`` (0 to 255): the mask alone, for unknown pictures."""
    light = (jnp.asarray(level) / 255.0) ** term.gamma
    return mosaic_of_grid(term, light * jnp.asarray(term.mask))


def mosaic_of_grid(
    term: Backscatter, grid: Float[Arrayish, "3 grid_rows grid_columns"]
) -> Float[Array, "rows columns"]:
    """Interpolate from the grid to every sample of the mosaic, each in its own colour, by cubic convolution."""
    grid = jnp.asarray(grid)
    by_column = cubic_weights(term.columns, term.step, grid.shape[2], grid.dtype)
    by_row = cubic_weights(term.rows, term.step, grid.shape[1], grid.dtype)
    mosaic = jnp.zeros((term.rows, term.columns), grid.dtype)
    for site in cfa_named(term.cfa).sites:
        down, across = site.samples
        mosaic = mosaic.at[site.samples].set(by_row[down] @ grid[site.channel] @ by_column[across].T)
    return mosaic


def cubic_weights(count: int, step: int, nodes: int, dtype: jnp.dtype) -> Float[Array, "count nodes"]:
    """Return the matrix of Keys' cubic convolution (1981, a = -1/2) from block centres to pixels.

    Beyond the last nodes it is linear.
    """
    position = (jnp.arange(count, dtype=dtype) + 0.5) / step - 0.5
    padded = jnp.arange(-2, nodes + 2, dtype=dtype)
    distance = jnp.abs(position[:, None] - padded)
    near = 1.5 * distance**3 - 2.5 * distance**2 + 1
    far = -0.5 * distance**3 + 2.5 * distance**2 - 4 * distance + 2
    weights = jnp.where(distance <= 1, near, jnp.where(distance < 2, far, 0.0))
    # A node beyond the edge is the straight continuation of the last two: value(-k) = (1 + k) v0 - k v1.
    inner = weights[:, 2:-2]
    before, after = weights[:, :2], weights[:, -2:]
    steps = jnp.array([2.0, 1.0], dtype)
    inner = inner.at[:, 0].add(before @ (1 + steps)).at[:, 1].add(-(before @ steps))
    steps = steps[::-1]
    return inner.at[:, -1].add(after @ (1 + steps)).at[:, -2].add(-(after @ steps))
