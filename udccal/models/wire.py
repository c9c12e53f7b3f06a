"""Wire: modulation by the panel's out-of-focus rows and columns over the field of view, times the shading.

The pupil's footprint on the panel is an ellipse whose centre moves with the pixel. An even field therefore becomes

    w(q) = exp(B(q)) [1 + sum_h a_h(q) cos(phase_h(q)) + b_h(q) sin(phase_h(q))],  phase_h = 2 pi (n X + m Y)

with (X, Y) the footprint's centre in panel periods, a projective function of the undistorted pixel. A harmonic's
amplitude is the slits' Fourier coefficient times that of the footprint: for a round, evenly lit pupil

    a_h = S_m(open_y) S_n(open_x) G(z),   z = pi (D / pitch) kappa,
    G(z) = 2 J1(z) / z,   S_m(f) = 2 sin(pi m f) / (pi m f),

kappa is the length of (n, m) seen through the footprint's shape. The openings narrow with the obliquity of the ray
because the structure has some depth. Short Legendre series in kappa describe how a real pupil differs from the ideal
one: they scale G, and shift its argument (z G'), for cosine and sine. Where no pupil explains the amplitudes of the
strongest harmonics, polynomials over the sensor are added to them.
"""

from __future__ import annotations

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from udccal.models.arrays import Arrayish
from udccal.models.bessel import bessel_j0_j1, sine_cosine
from udccal.models.geometry import Geometry, rotation_matrix, unproject

# Largest absolute value of a number in ``Wire.harmonics``.
HIGHEST_ORDER = 24
# Narrowest opening, as a part of the period.
LEAST_OPEN = 0.02


class Wire(eqx.Module):
    """Parameters of the wire map.

    Attributes:
        geometry: the geometry term; ``rotation_rad`` turns it for the wire.
        rotation_rad: rotation vector in rad, in panel coordinates, applied after the geometry's own.
        standoff_per_pitch: distance of the entrance pupil from the openings, in panel periods.
        offset_periods: panel coordinates (X, Y) of the pupil in periods, from the centre of an opening.
        footprint_per_pitch: diameter of the footprint in periods.
        row_open, column_open: open fraction of a period along Y and X for a ray along the normal.
        depth_per_pitch: depth of the opaque structure in periods; it narrows an opening by depth |slope|.
        harmonics: integers (n, m) per harmonic: periods along X (columns) and along Y (rows).
        frequency: (middle, half range) of kappa over the sensor, per harmonic.
        fields: coefficients by harmonic; phase (cos, sin); carrier (G, z G'); Legendre degree in kappa. The ideal
            round pupil has 1 at (cos, G, degree 0) and 0 elsewhere.
        amplitudes: Legendre coefficients over the sensor that are added to the amplitudes of the first harmonics, by
            harmonic, phase (cos, sin), degree in y and in x. It is usually empty: the pupil explains the amplitudes.
        baseline: Legendre coefficients of B without the mean openings, by degree in y and in x, over the sensor scaled
            to [-1, 1].
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
    """Return the first ``count`` Legendre polynomials at ``x``, by Bonnet's recursion."""
    x = jnp.asarray(x)
    values = [jnp.ones_like(x), x]
    for k in range(1, count - 1):
        values.append(((2 * k + 1) * x * values[k] - k * values[k - 1]) / (k + 1))
    return jnp.stack(values[:count])


def panel_rotation(wire: Wire) -> Float[Array, "3 3"]:
    """Return ``R_panel_camera`` of ``wire``: the geometry's rotation followed by the wire's own."""
    return rotation_matrix(wire.rotation_rad) @ rotation_matrix(wire.geometry.rotation_rad)


def slopes(wire: Wire, ideal: Float[Arrayish, "n 2"]) -> Float[Array, "2 n"]:
    """Return the slopes (dX/dz, dY/dz) of rays in panel coordinates.

    Args:
        wire: the wire term.
        ideal: ideal normalised image points (x/z, y/z).
    """
    ideal = jnp.asarray(ideal)
    rays = panel_rotation(wire) @ jnp.stack([ideal[:, 0], ideal[:, 1], jnp.ones_like(ideal[:, 0])])
    return rays[:2] / rays[2]


def openings(wire: Wire, slope: Float[Arrayish, "2 n"]) -> Float[Array, "2 n"]:
    """Return the open fraction along X and along Y for rays.

    Args:
        wire: the wire term.
        slope: slopes of the rays, from ``slopes``.
    """
    straight = jnp.stack([jnp.asarray(wire.column_open), jnp.asarray(wire.row_open)])
    return jnp.maximum(straight[:, None] - wire.depth_per_pitch * jnp.abs(jnp.asarray(slope)), LEAST_OPEN)


def kappa(wire: Wire, slope: Float[Arrayish, "2 n"]) -> Float[Array, "harmonics n"]:
    """Return the length of each harmonic's (n, m) through the footprint: a pupil square to the axis, projected."""
    rotation, slope = panel_rotation(wire), jnp.asarray(slope)
    harmonics = jnp.asarray(wire.harmonics)
    sides = [harmonics @ (rotation[:2, i : i + 1] - slope * rotation[2, i]) for i in (0, 1)]
    return jnp.sqrt(sides[0] ** 2 + sides[1] ** 2)


def carriers(
    wire: Wire, slope: Float[Arrayish, "2 n"], seen: Float[Arrayish, "harmonics n"]
) -> Float[Array, "2 harmonics n"]:
    """Return G and z G' of each harmonic times the slits' coefficients, for ``seen`` = ``kappa(wire, slope)``."""
    harmonics = jnp.asarray(wire.harmonics)[:, :, None]
    slit = slits(wire, openings(wire, slope))
    # cos(nX) cos(mY) is half the sum over (n, m) and (-n, m).
    crossed = jnp.where(jnp.all(harmonics != 0, axis=1), 0.5, 1.0)
    z = jnp.pi * wire.footprint_per_pitch * jnp.asarray(seen)
    j0, j1 = bessel_j0_j1(z)
    g = 2.0 * j1 / z
    return crossed * slit[0] * slit[1] * jnp.stack([g, 2.0 * (j0 - g)])


def slits(wire: Wire, width: Float[Array, "2 n"]) -> Float[Array, "2 harmonics n"]:
    """Return the slits' coefficients 2 sin(pi m f) / (pi m f), 1 where m is 0.

    Args:
        wire: the wire term.
        width: openings f along X and Y, from ``openings``.
    """
    order = jnp.abs(jnp.asarray(wire.harmonics)).T[..., None]
    sine = jnp.stack([_multiples(jnp.pi * f, m[:, 0])[1] for f, m in zip(width, order, strict=True)])
    sinc = sine / (jnp.pi * jnp.maximum(order, 1.0) * width[:, None])
    return jnp.where(order == 0, 1.0, 2.0 * sinc)


def waves(wire: Wire, periods: Float[Arrayish, "2 n"]) -> Float[Array, "2 harmonics n"]:
    """Return cos and sin of each harmonic's phase 2 pi (n X + m Y).

    Args:
        wire: the wire term.
        periods: (X, Y) where the rays meet the panel.
    """
    # Subtract whole periods, which would cost digits in single precision.
    phase = 2 * jnp.pi * (jnp.asarray(periods) - jnp.round(periods))
    order = jnp.asarray(wire.harmonics)
    (cosine_x, sine_x), (cosine_y, sine_y) = (_multiples(p, o) for p, o in zip(phase, order.T, strict=True))
    return jnp.stack([cosine_x * cosine_y - sine_x * sine_y, sine_x * cosine_y + cosine_x * sine_y])


def _multiples(phase: Float[Array, " n"], order: Float[Array, " harmonics"]) -> tuple[Array, Array]:
    """Return cos and sin of ``order`` times ``phase``, from one table for all harmonics."""
    multiples = jnp.arange(HIGHEST_ORDER + 1.0, dtype=phase.dtype)
    # A product with a selection matrix: many times faster on a CPU than gathering rows.
    chosen = (jnp.round(jnp.abs(order))[:, None] == multiples).astype(phase.dtype)
    sine, cosine = (jnp.matmul(chosen, part, precision="highest") for part in sine_cosine(multiples[:, None] * phase))
    return cosine, jnp.sign(order)[:, None] * sine


def field_powers(wire: Wire, seen: Float[Arrayish, "harmonics n"], degrees: int) -> Float[Array, "degrees harmonics n"]:
    """Return Legendre polynomials of each harmonic's kappa, scaled to [-1, 1] over its range.

    Args:
        wire: the wire term.
        seen: kappa of each harmonic at each ray.
        degrees: number of polynomials, from degree 0.
    """
    frequency = jnp.asarray(wire.frequency)
    return legendre((jnp.asarray(seen) - frequency[:, :1]) / frequency[:, 1:], degrees)


def modulation(wire: Wire, slope: Float[Arrayish, "2 n"], scaled: Float[Arrayish, "n 2"]) -> Float[Array, " n"]:
    """Return the sum of all harmonics, relative to the baseline.

    Args:
        wire: the wire term.
        slope: slopes of the rays, from ``slopes``.
        scaled: sensor positions, from ``scaled_positions``.
    """
    seen = kappa(wire, slope)
    fields = jnp.asarray(wire.fields)
    powers = field_powers(wire, seen, fields.shape[-1])
    periods = jnp.asarray(wire.offset_periods)[:, None] + wire.standoff_per_pitch * jnp.asarray(slope)
    carrier, wave = carriers(wire, slope, seen), waves(wire, periods)
    total = jnp.zeros_like(seen)
    # Unrolled over the few phases, carriers and degrees: the compiler fuses it into one fast loop.
    for p, c in ((0, 0), (0, 1), (1, 0), (1, 1)):
        series = sum(fields[:, p, c, d, None] * powers[d] for d in range(fields.shape[-1]))
        total = total + series * carrier[c] * wave[p]
    return jnp.sum(total, axis=0) + _beside_the_pupil(wire, wave, jnp.asarray(scaled))


def _beside_the_pupil(
    wire: Wire, wave: Float[Array, "2 harmonics n"], scaled: Float[Array, "n 2"]
) -> Float[Array, " n"] | float:
    """Sum the polynomial parts of the strongest harmonics' amplitudes, which no pupil explains."""
    strongest, _, count_y, count_x = jnp.shape(wire.amplitudes)
    if strongest == 0:
        return 0.0
    in_x, in_y = legendre(scaled[:, 0], count_x), legendre(scaled[:, 1], count_y)
    return jnp.einsum("hpyx,yn,xn,phn->n", jnp.asarray(wire.amplitudes), in_y, in_x, wave[:, :strongest])


def log_baseline(wire: Wire, scaled: Float[Arrayish, "n 2"], slope: Float[Arrayish, "2 n"]) -> Float[Array, " n"]:
    """Return B, the logarithm of the baseline.

    Args:
        wire: the wire term.
        scaled: sensor positions, from ``scaled_positions``.
        slope: slopes of the rays, from ``slopes``.
    """
    scaled = jnp.asarray(scaled)
    count_y, count_x = jnp.shape(wire.baseline)
    in_x, in_y = legendre(scaled[:, 0], count_x), legendre(scaled[:, 1], count_y)
    smooth = jnp.einsum("yx,yn,xn->n", jnp.asarray(wire.baseline), in_y, in_x)
    return smooth + jnp.sum(jnp.log(openings(wire, slope)), axis=0)


def scaled_positions(pixels: Float[Arrayish, "n 2"], rows: int, columns: int) -> Float[Array, "n 2"]:
    """Scale sensor pixels to [-1, 1] in both directions.

    Args:
        pixels: (x, y) in px.
        rows: rows of the sensor. columns: columns of the sensor.
    """
    return 2 * jnp.asarray(pixels) / jnp.array([columns - 1.0, rows - 1.0]) - 1


def wire_values(wire: Wire, pixels: Float[Arrayish, "n 2"], rows: int, columns: int) -> Float[Array, " n"]:
    """Return the wire w at pixels, with mean 1 over the sensor.

    Args:
        wire: the wire term.
        pixels: (x, y) in px.
        rows: rows of the sensor. columns: columns of the sensor.
    """
    slope = slopes(wire, unproject(wire.geometry, pixels))
    scaled = scaled_positions(pixels, rows, columns)
    return jnp.exp(log_baseline(wire, scaled, slope)) * (1 + modulation(wire, slope, scaled))


@functools.partial(jax.jit, static_argnames=("rows", "columns"))
def wire_map(wire: Wire, rows: int, columns: int) -> Float[Array, "rows columns"]:
    """Return the map of the whole sensor, mean 1: lens shading, panel transmission and modulation together.

    Args:
        wire: the wire term.
        rows: rows of the sensor. columns: columns of the sensor.
    """
    x = jnp.arange(columns, dtype=float)

    # Row by row: a hundred harmonics of one row fit into the processor's cache, and memory stays small.
    def one_row(y: Float[Array, ""]) -> Float[Array, " columns"]:
        return wire_values(wire, jnp.stack([x, jnp.full_like(x, y)], axis=-1), rows, columns)

    return jax.lax.map(one_row, jnp.arange(rows, dtype=float))
