"""Wire: the panel's out-of-focus rows and columns over the field of view, and the shading they ride on.

The pupil's footprint on the panel is an ellipse whose centre moves with the pixel. An even field therefore comes out as

    w(q) = exp(B(q)) [1 + sum_h a_h(q) cos(phase_h(q)) + b_h(q) sin(phase_h(q))],  phase_h = 2 pi (n X + m Y)

with (X, Y) the footprint's centre in panel periods, a projective function of the undistorted pixel. A harmonic's
amplitude is the slits' Fourier coefficient times that of the footprint: for a round, evenly lit pupil

    a_h = S_m(open_y) S_n(open_x) G(z),   z = pi (D / pitch) kappa,
    G(z) = 2 J1(z) / z,   S_m(f) = 2 sin(pi m f) / (pi m f),

where kappa is the length of (n, m) seen through the footprint's shape and the openings narrow with the obliquity of the
ray because the structure has some depth. What a real pupil does differently are short Legendre series in kappa: they
scale G, and shift its argument (z G'), for cosine and sine. Where no pupil explains the amplitudes of the strongest
harmonics, polynomials over the sensor are added to them.
"""

from __future__ import annotations

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from udccal.models.arrays import Arrayish
from udccal.models.bessel import bessel_j0_j1
from udccal.models.geometry import Geometry, rotation_matrix, unproject

# Whole numbers up to this may stand in ``Wire.harmonics``.
HIGHEST_ORDER = 24
_LEAST_OPEN = 0.02


class Wire(eqx.Module):
    """Parameters of the wire map.

    Attributes:
        geometry: as fitted on its own; the wire turns it by ``rotation``.
        rotation_rad: rotation vector in rad, in panel coordinates, applied after the geometry's own.
        standoff_per_pitch: distance of the entrance pupil from the openings, in panel periods.
        offset_periods: panel coordinates (X, Y) of the pupil in periods, from the centre of an opening.
        footprint_per_pitch: diameter of the footprint in periods.
        row_open, column_open: open fraction of a period along Y and X for a ray along the normal.
        depth_per_pitch: depth of the opaque structure in periods; it narrows an opening by depth |slope|.
        harmonics: whole numbers (n, m) per harmonic: periods along X (columns) and along Y (rows).
        frequency: (middle, half range) of kappa over the sensor, per harmonic.
        fields: coefficients by harmonic; phase (cos, sin); carrier (G, z G'); Legendre degree in kappa. The ideal
            round pupil has 1 at (cos, G, degree 0) and 0 elsewhere.
        amplitudes: of the first harmonics, Legendre coefficients over the sensor of what is added to their amplitude;
            by harmonic, phase (cos, sin), degree in y and in x. Mostly of no harmonic: what the pupil does is enough.
        baseline: Legendre coefficients by degree in y and in x, over the sensor scaled to [-1, 1], of the logarithm
            of everything in B but the mean openings.
    """

    geometry: Geometry
    rotation_rad: Float[Arrayish, "3"]
    standoff_per_pitch: Float[Arrayish, ""]
    offset_periods: Float[Arrayish, "2"]
    footprint_per_pitch: Float[Arrayish, ""]
    row_open: Float[Arrayish, ""]
    column_open: Float[Arrayish, ""]
    depth_per_pitch: Float[Arrayish, ""]
    harmonics: Float[Arrayish, "harmonics 2"]
    frequency: Float[Arrayish, "harmonics 2"]
    fields: Float[Arrayish, "harmonics 2 2 degrees"]
    amplitudes: Float[Arrayish, "strongest 2 amplitude_degrees_y amplitude_degrees_x"]
    baseline: Float[Arrayish, "degrees_y degrees_x"]


def legendre(x: Float[Arrayish, "*n"], count: int) -> Float[Array, "count *n"]:
    """The first ``count`` Legendre polynomials at ``x``."""
    x = jnp.asarray(x)
    values = [jnp.ones_like(x), x]
    for k in range(1, count - 1):
        values.append(((2 * k + 1) * x * values[k] - k * values[k - 1]) / (k + 1))
    return jnp.stack(values[:count])


def panel_rotation(wire: Wire) -> Float[Array, "3 3"]:
    """``R_panel_camera`` as the wire sees it."""
    return rotation_matrix(wire.rotation_rad) @ rotation_matrix(wire.geometry.rotation_rad)


def slopes(wire: Wire, ideal: Float[Arrayish, "n 2"]) -> Float[Array, "2 n"]:
    """Slopes (dX/dz, dY/dz) in panel coordinates of rays given by ideal normalised image points."""
    ideal = jnp.asarray(ideal)
    rays = panel_rotation(wire) @ jnp.stack([ideal[:, 0], ideal[:, 1], jnp.ones_like(ideal[:, 0])])
    return rays[:2] / rays[2]


def openings(wire: Wire, slope: Float[Arrayish, "2 n"]) -> Float[Array, "2 n"]:
    """Open fraction along X and along Y for rays of these slopes."""
    straight = jnp.stack([jnp.asarray(wire.column_open), jnp.asarray(wire.row_open)])
    return jnp.maximum(straight[:, None] - wire.depth_per_pitch * jnp.abs(jnp.asarray(slope)), _LEAST_OPEN)


def kappa(wire: Wire, slope: Float[Arrayish, "2 n"]) -> Float[Array, "harmonics n"]:
    """Length of each harmonic's (n, m) seen through the footprint's shape: a pupil square to the axis, projected."""
    rotation, slope = panel_rotation(wire), jnp.asarray(slope)
    harmonics = jnp.asarray(wire.harmonics)
    sides = [harmonics @ (rotation[:2, i : i + 1] - slope * rotation[2, i]) for i in (0, 1)]
    return jnp.sqrt(sides[0] ** 2 + sides[1] ** 2)


def carriers(
    wire: Wire, slope: Float[Arrayish, "2 n"], seen: Float[Arrayish, "harmonics n"]
) -> Float[Array, "2 harmonics n"]:
    """G and z G' of each harmonic, times the slits' coefficients."""
    harmonics = jnp.asarray(wire.harmonics)[:, :, None]
    slit = jnp.where(harmonics == 0, 1.0, 2.0 * jnp.sinc(harmonics * openings(wire, slope)))
    # cos(nX) cos(mY) is half the sum over (n, m) and (-n, m).
    crossed = jnp.where(jnp.all(harmonics != 0, axis=1), 0.5, 1.0)
    z = jnp.pi * wire.footprint_per_pitch * jnp.asarray(seen)
    j0, j1 = bessel_j0_j1(z)
    g = 2.0 * j1 / z
    return crossed * slit[:, 0] * slit[:, 1] * jnp.stack([g, 2.0 * (j0 - g)])


def waves(wire: Wire, slope: Float[Arrayish, "2 n"]) -> Float[Array, "2 harmonics n"]:
    """cos and sin of each harmonic's phase 2 pi (n X + m Y)."""
    periods = jnp.asarray(wire.offset_periods)[:, None] + wire.standoff_per_pitch * jnp.asarray(slope)
    # Whole periods leave before single precision would feel them.
    phase = 2 * jnp.pi * (periods - jnp.round(periods))
    order = jnp.asarray(wire.harmonics)
    (cosine_x, sine_x), (cosine_y, sine_y) = (_multiples(p, o) for p, o in zip(phase, order.T, strict=True))
    return jnp.stack([cosine_x * cosine_y - sine_x * sine_y, sine_x * cosine_y + cosine_x * sine_y])


def _multiples(phase: Float[Array, " n"], order: Float[Array, " harmonics"]) -> tuple[Array, Array]:
    """cos and sin of ``order`` times ``phase``, from one table for all harmonics."""
    multiples = jnp.arange(HIGHEST_ORDER + 1.0, dtype=phase.dtype)
    # A product with a selection matrix: many times faster on a CPU than gathering rows.
    chosen = (jnp.round(jnp.abs(order))[:, None] == multiples).astype(phase.dtype)
    table = multiples[:, None] * phase
    cosine, sine = (jnp.matmul(chosen, part, precision="highest") for part in (jnp.cos(table), jnp.sin(table)))
    return cosine, jnp.sign(order)[:, None] * sine


def field_powers(wire: Wire, seen: Float[Arrayish, "harmonics n"], degrees: int) -> Float[Array, "degrees harmonics n"]:
    """Legendre polynomials of each harmonic's kappa over its range."""
    frequency = jnp.asarray(wire.frequency)
    return legendre((jnp.asarray(seen) - frequency[:, :1]) / frequency[:, 1:], degrees)


def modulation(wire: Wire, slope: Float[Arrayish, "2 n"], scaled: Float[Arrayish, "n 2"]) -> Float[Array, " n"]:
    """Sum of all harmonics, for rays of these slopes at sensor positions ``scaled`` to [-1, 1]."""
    seen = kappa(wire, slope)
    fields = jnp.asarray(wire.fields)
    powers = field_powers(wire, seen, fields.shape[-1])
    carrier, wave = carriers(wire, slope, seen), waves(wire, slope)
    total = jnp.zeros_like(seen)
    # Written out over the few phases, carriers and degrees: the compiler makes one fast loop of it.
    for p, c in ((0, 0), (0, 1), (1, 0), (1, 1)):
        series = sum(fields[:, p, c, d, None] * powers[d] for d in range(fields.shape[-1]))
        total = total + series * carrier[c] * wave[p]
    return jnp.sum(total, axis=0) + _beside_the_pupil(wire, wave, jnp.asarray(scaled))


def _beside_the_pupil(
    wire: Wire, wave: Float[Array, "2 harmonics n"], scaled: Float[Array, "n 2"]
) -> Float[Array, " n"] | float:
    """The harmonics whose amplitudes have a part that is a polynomial over the sensor: that part."""
    strongest, _, count_y, count_x = jnp.shape(wire.amplitudes)
    if strongest == 0:
        return 0.0
    in_x, in_y = legendre(scaled[:, 0], count_x), legendre(scaled[:, 1], count_y)
    return jnp.einsum("hpyx,yn,xn,phn->n", jnp.asarray(wire.amplitudes), in_y, in_x, wave[:, :strongest])


def log_baseline(wire: Wire, scaled: Float[Arrayish, "n 2"], slope: Float[Arrayish, "2 n"]) -> Float[Array, " n"]:
    """B at sensor positions ``scaled`` to [-1, 1]."""
    scaled = jnp.asarray(scaled)
    count_y, count_x = jnp.shape(wire.baseline)
    in_x, in_y = legendre(scaled[:, 0], count_x), legendre(scaled[:, 1], count_y)
    smooth = jnp.einsum("yx,yn,xn->n", jnp.asarray(wire.baseline), in_y, in_x)
    return smooth + jnp.sum(jnp.log(openings(wire, slope)), axis=0)


def scaled_positions(pixels: Float[Arrayish, "n 2"], rows: int, columns: int) -> Float[Array, "n 2"]:
    """Sensor pixels to [-1, 1] in both directions."""
    return 2 * jnp.asarray(pixels) / jnp.array([columns - 1.0, rows - 1.0]) - 1


def wire_values(wire: Wire, pixels: Float[Arrayish, "n 2"], rows: int, columns: int) -> Float[Array, " n"]:
    """The map at given pixels of a sensor of ``rows`` x ``columns``."""
    slope = slopes(wire, unproject(wire.geometry, pixels))
    scaled = scaled_positions(pixels, rows, columns)
    return jnp.exp(log_baseline(wire, scaled, slope)) * (1 + modulation(wire, slope, scaled))


@functools.partial(jax.jit, static_argnames=("rows", "columns"))
def wire_map(wire: Wire, rows: int, columns: int) -> Float[Array, "rows columns"]:
    """The multiplicative map of the whole sensor, mean 1: lens shading, panel transmission and modulation together."""
    x = jnp.arange(columns, dtype=float)

    # Row by row: a hundred harmonics of one row stay in the processor's cache, and memory stays small.
    def one_row(y: Float[Array, ""]) -> Float[Array, " columns"]:
        return wire_values(wire, jnp.stack([x, jnp.full_like(x, y)], axis=-1), rows, columns)

    return jax.lax.map(one_row, jnp.arange(rows, dtype=float))
