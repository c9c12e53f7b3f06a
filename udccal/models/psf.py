"""psf: the kernel of a point source, as a field over the sensor.

The kernel is the sum of two parts. Diffraction by the panel has few parameters and is exact far from the source. The
residual describes all other blur: an image whose pixels are polynomials of the field position. The kernel belongs to
the source point.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from udccal.models.arrays import Arrayish
from udccal.models.diffraction import (
    Diffraction,
    LocalFrame,
    average_transfer,
    is_shaped,
    local_frame,
    node_scale,
)
from udccal.models.fields import polynomial_basis
from udccal.models.geometry import Geometry, area_of_pixels, panel_directions
from udccal.models.interference import (
    footprint_place,
    interference_transfer,
    node_overlaps,
    overlap_tables,
    strengths,
)
from udccal.models.lattice import Joined, Lattice, lattice_for, low_pass, sample, spline_coefficients

# A kernel is a cross: detail finer than this band (cycles per pixel) along an axis matters only near the other axis.
# A cubic spline follows it to 0.3 cycles per node, and to 0.4 with errors of up to a quarter beside the peak.
_BAND = (0.5, 1.2)
_COARSE, _MARGIN = 4, 1.25
_FINE_PX, _FINE_BLEND_PX = 28, (10.0, 14.0)
# Interference between orders is computed on one lattice over this many (rows, columns), and left out beyond them.
_INTERFERENCE_PX, _INTERFERENCE_PER_PX = (96, 48), 6
# Smaller kernels are cut from one of this size: below it little time is saved, and tiny transforms compile slowly.
_LEAST_PX = 32


class PsfField(eqx.Module):
    """The psf term.

    Attributes:
        geometry: camera geometry, which gives each pixel's direction.
        diffraction: the panel's diffraction.
        diffraction_fraction: 1, or 0 when the residual is the whole kernel.
        residual: coefficients of the residual image; its terms are ``fields.polynomial_basis`` of ``degree``.
        centre_px, half_px: the polynomials take (p - centre) / half at position p.
        support_px: distance (across, down) from the source beyond which the captured frames showed none of the
            kernel's light; the sensor's size where they showed light everywhere.
        degree: degree of the residual's polynomials; -1 for no residual.
        fine: lattice nodes per pixel where detail matters; see ``fine_oversample``.
    """

    geometry: Geometry
    diffraction: Diffraction
    diffraction_fraction: Float[Arrayish, ""]
    residual: Float[Arrayish, "terms 3 window_rows window_columns"]
    centre_px: Float[Arrayish, "2"]
    half_px: Float[Arrayish, "2"]
    support_px: Float[Arrayish, "2"]
    degree: int = eqx.field(static=True)
    fine: int = eqx.field(static=True, default=8)


def psf_kernels(
    field: PsfField, positions_px: Float[Arrayish, "n 2"], rows: int, columns: int
) -> Float[Array, "n 3 rows columns"]:
    """Return the kernels of point sources, integrated over pixels; each colour sums to 1.

    Args:
        field: the psf term.
        positions_px: (x, y) of each source on the sensor, which is the centre of the kernel's middle sample.
        rows: odd number of rows. columns: odd number of columns.
    """
    return _kernels(field, jnp.asarray(positions_px), rows, columns, is_shaped(field.diffraction))


@eqx.filter_jit
def _kernels(
    field: PsfField, positions_px: Float[Array, "n 2"], rows: int, columns: int, shaped: bool
) -> Float[Array, "n 3 rows columns"]:
    def one(position: Float[Array, "2"]) -> Float[Array, "3 rows columns"]:
        kernel = field.diffraction_fraction * diffraction_kernel(
            field.diffraction, field.geometry, position, rows, columns, field.fine, shaped
        ) + residual_kernel(field, position, rows, columns)
        return kernel / jnp.sum(kernel, axis=(1, 2), keepdims=True)

    return jax.lax.map(one, positions_px)


def fine_oversample(pupil_diameter_mm: float, focal_px: float) -> int:
    """Return the lattice nodes per pixel, from 6 to 14, that resolve nearly all detail of an ideal lens in blue light.

    Args:
        pupil_diameter_mm: diameter of the entrance pupil.
        focal_px: focal length.
    """
    cycles_per_px = pupil_diameter_mm / 480e-6 / focal_px
    return min(max(2 * round(0.95 * cycles_per_px), 6), 14)


def diffraction_kernel(
    model: Diffraction,
    geometry: Geometry,
    position_px: Float[Arrayish, "2"],
    rows: int,
    columns: int,
    fine: int,
    shaped: bool,
) -> Float[Array, "3 rows columns"]:
    """Return the kernel by diffraction alone, as a fraction of all the source's light."""
    frame = local_frame(geometry, position_px)
    spectra = jnp.asarray(model.spectrum)
    y, x = jnp.meshgrid(jnp.arange(rows) - rows // 2, jnp.arange(columns) - columns // 2, indexing="ij")
    offsets = jnp.stack([x.ravel(), y.ravel()], axis=-1) * 1.0
    points, density = lattice_points(geometry, frame, position_px, offsets)
    size_px = (max(rows, _LEAST_PX), max(columns, _LEAST_PX))
    values = _cross(lambda grid: average_transfer(model, frame, grid, spectra, shaped=shaped), points, size_px, fine)
    close_y, close_x = (min(size, most) * _MARGIN for size, most in zip(size_px, _INTERFERENCE_PX, strict=True))
    grid = lattice_for(close_y, close_x, _INTERFERENCE_PER_PX, _INTERFERENCE_PER_PX)
    overlaps = node_overlaps(model, frame, grid, overlap_tables(model, frame))
    strength = strengths(model, footprint_place(model, frame))
    interference = interference_transfer(model, frame, grid, spectra, overlaps, strength)
    values = values + sample(grid, spline_coefficients(grid, interference), points)
    return (values * density[:, None]).T.reshape(-1, rows, columns)


def _cross(
    transfer: Callable[[Joined], Float[Array, "c rows half"]],
    points: Float[Array, "n 2"],
    size_px: tuple[int, int],
    fine: int,
) -> Float[Array, "n c"]:
    """Evaluate a transfer function's picture at points, in four bands: coarse or fine along each axis."""
    rows, columns = size_px
    coarse = lattice_for(rows * _MARGIN, columns * _MARGIN, _COARSE, _COARSE)
    dense = lattice_for(_FINE_PX * _MARGIN, _FINE_PX * _MARGIN, fine, fine)
    whole, start, half = transfer(Joined(coarse, dense)), coarse.rows, coarse.frequency_x.size
    values: Array | float = 0.0
    for fine_y, fine_x in itertools.product((False, True), repeat=2):
        down, across = (dense if fine_y else coarse), (dense if fine_x else coarse)
        grid = Lattice(down.rows, across.columns, down.per_px_y, across.per_px_x)
        part = whole[:, slice(start, None) if fine_y else slice(start)]
        part = part[:, :, slice(half, None) if fine_x else slice(half)]
        band = _band(grid.frequency_y, fine_y)[:, None] * _band(grid.frequency_x, fine_x)
        coefficients = spline_coefficients(grid, part * band)
        near = jnp.ones(points.shape[0])
        near = near * low_pass(points[:, 0], *_FINE_BLEND_PX) if fine_x else near
        near = near * low_pass(points[:, 1], *_FINE_BLEND_PX) if fine_y else near
        values = values + near[:, None] * sample(grid, coefficients, points)
    return jnp.asarray(values)


def lattice_points(
    geometry: Geometry, frame: LocalFrame, position_px: Float[Arrayish, "2"], offsets_px: Float[Array, "n 2"]
) -> tuple[Float[Array, "n 2"], Float[Array, " n"]]:
    """Return pixels in units of the lattice around a source, and the lattice area that each covers.

    Args:
        geometry: camera geometry.
        frame: geometry around the source.
        position_px: (x, y) of the source on the sensor.
        offsets_px: (x, y) of the pixels' centres from the source.
    """
    pixels = jnp.asarray(position_px) + offsets_px
    scale = node_scale(frame)
    points = (panel_directions(geometry, pixels)[:, :2] - frame.direction[:2]) / scale
    return points, area_of_pixels(geometry, pixels) / (scale[0] * scale[1])


def residual_kernel(
    field: PsfField, position_px: Float[Array, "2"], rows: int, columns: int
) -> Float[Array, "3 rows columns"]:
    """Return the residual image at a position, cut or padded with zeros to ``rows`` x ``columns``."""
    residual = jnp.asarray(field.residual)
    unit = (position_px - jnp.asarray(field.centre_px)) / jnp.asarray(field.half_px)
    image = jnp.einsum("t,tcyx->cyx", polynomial_basis(unit[None], field.degree)[0], residual)
    for axis, size in ((1, rows), (2, columns)):
        spare = (size - image.shape[axis]) // 2
        if spare < 0:
            image = jax.lax.slice_in_dim(image, -spare, image.shape[axis] + spare, axis=axis)
        else:
            image = jnp.pad(image, [(spare, spare) if a == axis else (0, 0) for a in range(3)])
    return image


def _band(frequency: Float[Arrayish, " n"], fine: bool) -> Float[Array, " n"]:
    low = low_pass(frequency, *_BAND)
    return 1.0 - low if fine else low
