"""Interference between neighbouring diffraction orders: the part of the kernel that depends on the footprint's place.

These are the terms of ``models.diffraction`` with (g, h) other than (0, 0). They move about one percent of the light.
Between the orders, where little light falls, they dominate. Only the lowest terms matter.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udccal.models.arrays import Arrayish
from udccal.models.bessel import sine_cosine
from udccal.models.diffraction import (
    Diffraction,
    LocalFrame,
    blur_variance,
    lattice_frequencies,
    relative_lag,
    sensor_transfer,
    slits_along,
    slits_of,
    through_sensor,
)
from udccal.models.lattice import Lattice

# (g, h): periods along columns and rows. Each term includes its opposite (-g, -h).
TERMS = ((0.0, 1.0), (0.0, 2.0), (1.0, 0.0), (2.0, 0.0), (1.0, 1.0), (1.0, -1.0))
COLUMN_OF, ROW_OF = np.abs(np.array(TERMS, dtype=np.int32)).T
HIGHEST_ORDER = int(max(COLUMN_OF.max(), ROW_OF.max()))
_QUADRATURE = 32
_TABLE = 256


def interference_transfer(
    model: Diffraction,
    frame: LocalFrame,
    lattice: Lattice,
    spectra: Float[Array, "3 nodes"],
    overlaps: Float[Arrayish, "nodes terms rows half"],
    strength: Float[Arrayish, " terms"],
    disc_px: Float[Arrayish, ""] = 0.0,
) -> Float[Array, "3 rows half"]:
    """Return the transfer functions of the interference, to be added to ``average_transfer``.

    Args:
        model: the diffraction term.
        frame: geometry around the source.
        lattice: lattice in panel directions around the source.
        spectra: light of each colour at the model's wavelength nodes.
        overlaps: from ``node_overlaps``; they hardly change during a fit.
        strength: from ``strengths``.
        disc_px: diameter of a round source on the sensor; 0 for a point.
    """
    fx, fy = lattice_frequencies(frame, lattice)
    columns, rows = slits_of(model, slits_along(model, frame), fx, fy, HIGHEST_ORDER)

    def add(
        total: Float[Array, "3 rows half"], node: tuple[Array, Array, Array, Array]
    ) -> tuple[Float[Array, "3 rows half"], None]:
        column, row, overlap, part = node
        down = jnp.asarray(strength)[:, None] * row[ROW_OF]
        here = jnp.sum(down[:, :, None] * column[COLUMN_OF][:, None, :] * overlap, axis=0)
        return total + part[:, None, None] * here, None

    nodes = (jnp.moveaxis(columns, -1, 0), jnp.moveaxis(rows, -1, 0), jnp.asarray(overlaps), spectra.T)
    total, _ = jax.lax.scan(add, jnp.zeros((3, rows.shape[1], columns.shape[1])), nodes)
    return through_sensor(total, sensor_transfer(frame, fx, fy, blur_variance(model, frame), disc_px))


def footprint_place(model: Diffraction, frame: LocalFrame) -> Float[Array, "2"]:
    """Return the footprint's centre on columns and rows in pitches, for the source of ``frame`` and this ``model``."""
    return jnp.asarray(model.offset_periods) + model.standoff_per_pitch * frame.direction[:2] / frame.direction[2]


def strengths(model: Diffraction, place: Float[Arrayish, "2"]) -> Float[Array, " terms"]:
    """Return the signed strength of each term: 2 visibility cos(2 pi (g X + h Y)).

    Args:
        model: the diffraction term.
        place: (X, Y), the footprint's centre on columns and rows in pitches.
    """
    return model.visibility * 2.0 * jnp.cos(2.0 * jnp.pi * (jnp.array(TERMS) @ jnp.asarray(place)))


def node_overlaps(
    model: Diffraction, frame: LocalFrame, lattice: Lattice, tables: Float[Array, "terms y x"]
) -> Float[Array, "nodes terms rows half"]:
    """Return H_gh for the wavelength of every node at every frequency of a lattice.

    Args:
        model: the diffraction term.
        frame: geometry around the source.
        lattice: lattice in panel directions around the source.
        tables: from ``overlap_tables``.
    """
    lag_x, lag_y = relative_lag(model, frame, *lattice_frequencies(frame, lattice))
    lag_x, lag_y = lag_x.astype(tables.dtype), lag_y.astype(tables.dtype)
    scales = (jnp.asarray(model.wavelengths_nm) * 1e-6).astype(tables.dtype)
    return jax.lax.map(lambda scale: _look_up(tables, lag_x * scale, lag_y * scale), scales)


def disc_overlap_coefficient(lag: Float[Arrayish, "*n 2"], wave: Float[Arrayish, "2"]) -> Float[Array, "*n"]:
    """Return the Fourier coefficient, per disc area, of a disc of diameter 1 times itself moved by ``lag``.

    ``wave`` is in cycles per diameter. The common part is a lens of half-thickness w(t) = sqrt(1/4 - t^2) - |lag| / 2
    around its long axis t. The integral across it is elementary. The integral along it uses Gauss-Legendre quadrature
    in t = t_max sin(angle).
    """
    lag = jnp.asarray(lag)
    lag = lag + jnp.array([1e-6, 0.0], lag.dtype)
    distance = jnp.sqrt(jnp.sum(lag**2, axis=-1))
    axis = lag / distance[..., None]
    across = axis @ jnp.asarray(wave)
    along = axis[..., 0] * jnp.asarray(wave)[1] - axis[..., 1] * jnp.asarray(wave)[0]
    half = jnp.sqrt(jnp.maximum(0.25 - distance**2 / 4.0, 0.0))
    nodes, weights = np.polynomial.legendre.leggauss(_QUADRATURE)
    # The integrand is even: integrate one half and double it.
    angle = jnp.asarray((nodes + 1.0) * np.pi / 4, lag.dtype)
    weight = jnp.asarray(weights * np.pi / 2, lag.dtype)
    t = half[..., None] * jnp.sin(angle)
    width = jnp.maximum(jnp.sqrt(0.25 - t * t) - distance[..., None] / 2.0, 0.0)
    phase = 2.0 * jnp.pi * across[..., None] * width
    small = jnp.abs(phase) < 1e-2
    slab = 2.0 * width * jnp.where(small, 1.0 - phase**2 / 6.0, sine_cosine(phase)[0] / jnp.where(small, 1.0, phase))
    integrand = slab * sine_cosine(2.0 * jnp.pi * along[..., None] * t)[1] * half[..., None] * jnp.cos(angle)
    return integrand @ weight * (4.0 / jnp.pi)


def overlap_tables(model: Diffraction, frame: LocalFrame) -> Float[Array, "terms y x"]:
    """Return H_gh of every term of ``model`` around a source, on a grid of lags.

    Args:
        model: the diffraction term.
        frame: geometry around the source.

    Returns:
        tables over lags x from 0 to 1 and y from -1 to 1 diameters of the pupil.
    """
    # Single precision takes half the time. Its error is a millionth of these terms, which are a hundredth of the light.
    waves = (jnp.array(TERMS) @ frame.footprint * (model.pupil_diameter_mm / model.pitch_mm)).astype(jnp.float32)
    x, y = jnp.linspace(0.0, 1.0, _TABLE + 1), jnp.linspace(-1.0, 1.0, 2 * _TABLE + 1)
    grid = jnp.stack(jnp.meshgrid(x, y), axis=-1).astype(jnp.float32)
    return jax.lax.map(lambda wave: disc_overlap_coefficient(grid, wave), waves)


def _look_up(
    tables: Float[Array, "t y x"], lag_x: Float[Array, "rows half"], lag_y: Float[Array, "rows half"]
) -> Float[Array, "t rows half"]:
    """Interpolate bilinearly; a lag and its opposite give the same value; discs a diameter apart do not overlap."""
    flip = jnp.where(lag_x < 0, -1.0, 1.0)
    x, y = lag_x * flip * _TABLE, (lag_y * flip + 1.0) * _TABLE
    inside = lag_x**2 + lag_y**2 < 1.0
    column = jnp.clip(jnp.floor(x), 0, _TABLE - 1).astype(jnp.int32)
    row = jnp.clip(jnp.floor(y), 0, 2 * _TABLE - 1).astype(jnp.int32)
    right, down = jnp.clip(x - column, 0.0, 1.0), jnp.clip(y - row, 0.0, 1.0)
    flat = tables.reshape(tables.shape[0], -1)
    corner = row * (_TABLE + 1) + column
    below = corner + _TABLE + 1
    top = flat[:, corner] * (1.0 - right) + flat[:, corner + 1] * right
    bottom = flat[:, below] * (1.0 - right) + flat[:, below + 1] * right
    return jnp.where(inside, top * (1.0 - down) + bottom * down, 0.0)
