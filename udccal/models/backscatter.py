"""Backscatter: what the lit panel itself sends into the lens, as a function of the picture it shows.

Every panel pixel carries one small emitter per primary. A sensor pixel collects the emitters inside the pupil's
footprint on the panel: the pupil, projected along the pixel's ray, an ellipse a few panel pixels wide. The panel is far
out of focus, so that the footprint hardly depends on where the lens is focused. A second, fainter copy comes by
reflection at the front face of the glass, from a plane that appears deeper. With L = (picture / 255)^gamma,

    b_c(q) = mask_c(q) sum_p C[c, p] S_p(q) / sum_p C[c, p] S_p(q; white),
    S_p(q) = sum over panel pixels of (share of emitter p inside the footprint of q) L_p.

So ``mask`` is what an all-white panel gives, in e-/s, and the fraction is a low-pass of the panel's light mixed from
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
        geometry: where rays go.
        mask: e-/s that an all-white panel gives, by camera colour, at the grid of ``grid_positions``.
        mix: camera colour from primary; rows sum to 1.
        gamma: exponent of the panel's transfer curve.
        pitch_mm: panel pixels' distance.
        pupil_diameter_mm: diameter of the entrance pupil as the footprint shows it.
        standoff_mm: from the pupil to the plane of the emitters.
        emitters_px: (x, y) of each primary's emitter from the centre of its panel pixel.
        softness_px: width (one sigma) of the footprint's edge, the size of an emitter included.
        reflection: light of the reflected copy relative to the direct one.
        reflection_mm: how much deeper the reflected copy appears.
        columns, rows, cfa: the sensor. step: spacing of the grid in px.
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
    """A term worked out for one panel size: apply it to any number of pictures with ``response_rate``.

    ``shares`` holds, per grid position and primary, the share of each emitter in a window; ``pixels`` its place in the
    row-major picture; ``white`` the term's mask over the mixed white response.
    """

    term: Backscatter
    shares: Float[Array, "positions window2 3"]
    pixels: Int[Array, "positions window2"]
    gain: Float[Array, "3 positions"]


def grid_positions(
    columns: int, rows: int, step: int
) -> tuple[Float[Array, " grid_columns"], Float[Array, " grid_rows"]]:
    """Sensor x and y of the grid: centres of whole blocks of ``step`` x ``step`` pixels from the top left."""
    x, y = (step * (jnp.arange(count // step) + 0.5) - 0.5 for count in (columns, rows))
    return x, y


def footprints(
    term: Backscatter, rays: Float[Arrayish, "n 3"], standoff_mm: Float[Arrayish, ""]
) -> tuple[Float[Array, "n 2"], Float[Array, "n 2 2"]]:
    """The pupil's footprint along ``rays`` (panel coordinates) on a plane at ``standoff_mm`` from the pupil.

    Returns:
        (centre, shape) in panel pixels: the ellipse ``centre + shape @ u`` over the unit disc of u. A pupil point lies
        at R_panel_camera (r u, 0) from the pupil's centre; a ray of slope t = (s_x, s_y) / s_z through it meets the
        plane at P = pupil_xy + t distance + (R_xy - t R_z) r u.
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
    """Share of each emitter in a window of panel pixels that is seen along rays, direct and reflected together.

    ``corner`` is the (column, row) of the window's first panel pixel. Shares are per area of the footprint in panel
    pixels, so that they sum to about 1.
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
    """Soft indicator of the ellipse: the normal distribution of the distance from its edge (to first order)."""
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
    """(column, row) of the first panel pixel of the window around each ray's footprints."""
    centre, _ = footprints(term, rays, term.standoff_mm + term.reflection_mm * 0.5)
    middle = centre - jnp.asarray(term.emitters_px).mean(axis=0)
    return jnp.round(middle - (term.window - 1) / 2).astype(jnp.int32)


def panel_light(term: Backscatter, picture: Num[Arrayish, "*n 3"]) -> Float[Array, "*n 3"]:
    """Linear light of each primary, 0 to 1, of picture values 0 to 255."""
    return (jnp.asarray(picture, dtype=float) / 255.0) ** term.gamma


def mixed_colours(term: Backscatter, primaries: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    """Camera colours from primaries, as a sum: jaxlib 0.10.2 miscompiles small matrix products over long arrays."""
    return (primaries[..., None, :] * jnp.asarray(term.mix)).sum(axis=-1)


@functools.partial(jax.jit, static_argnums=(1, 2))
def panel_response(term: Backscatter, panel_rows: int, panel_columns: int) -> PanelResponse:
    """Work a term out for a panel of that many pixels; the panel is dark beyond its edges."""
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
    """Shares with those beyond the panel's edges taken out, and each window place's index in a row-major picture."""
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
    """Mosaic of backscatter in e-/s before the wire, while the panel shows ``picture`` (0 to 255)."""
    return mosaic_of_grid(response.term, response_grid(response, picture))


@jax.jit
def backscatter_rate(
    term: Backscatter, picture: Num[Arrayish, "panel_rows panel_columns 3"]
) -> Float[Array, "rows columns"]:
    """Mosaic of backscatter in e-/s before the wire; for several pictures keep one ``panel_response``."""
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
    """Cubic interpolation from the grid to every sample of the mosaic, each of its own colour."""
    grid = jnp.asarray(grid)
    by_column = _cubic_weights(term.columns, term.step, grid.shape[2], grid.dtype)
    by_row = _cubic_weights(term.rows, term.step, grid.shape[1], grid.dtype)
    mosaic = jnp.zeros((term.rows, term.columns), grid.dtype)
    for site in cfa_named(term.cfa).sites:
        down, across = site.samples
        mosaic = mosaic.at[site.samples].set(by_row[down] @ grid[site.channel] @ by_column[across].T)
    return mosaic


def _cubic_weights(count: int, step: int, nodes: int, dtype: jnp.dtype) -> Float[Array, "count nodes"]:
    """Matrix of Keys' cubic convolution (a = -1/2) from block centres to pixels; linear beyond the outermost nodes."""
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
