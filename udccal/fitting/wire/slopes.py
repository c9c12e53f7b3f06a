"""How the wire's values answer to its ten shape parameters, pixel by pixel, written out.

The modulation depends on the shape through few numbers per pixel: where its ray meets the panel (X, Y), the two
openings, the three of the footprint's ellipse, and the pupil. Sums over the harmonics are made once per such number;
what turns it into the shape parameters knows nothing of harmonics. That is several times quicker than derivatives of
the whole model one by one.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from udccal.models.bessel import bessel_j0_j1
from udccal.models.wire import Wire, field_powers, legendre, openings, panel_rotation, slopes, waves

SHAPE_PARAMETERS = 10


class Slopes(NamedTuple):
    """At each pixel: 1 + modulation, exp(B), and derivatives relative to exp(B).

    ``shape`` is by the ten parameters of ``move``; ``wave``, ``carrier`` (slits' coefficients included) and ``powers``
    are the factors of the linear field coefficients.
    """

    whole: Float[Array, " n"]
    base: Float[Array, " n"]
    shape: Float[Array, "10 n"]
    wave: Float[Array, "2 harmonics n"]
    carrier: Float[Array, "2 harmonics n"]
    powers: Float[Array, "degrees harmonics n"]


class _Seen(NamedTuple):
    """What the modulation and the baseline depend on the shape through."""

    periods: Float[Array, "2 n"]
    openings: Float[Array, "2 n"]
    ellipse: Float[Array, "3 n"]
    log_pupil: Float[Array, ""]


def shape_vector(wire: Wire) -> Float[np.ndarray, "10"]:
    """Rotation (3, rad), log stand-off, offset (2), log pupil, row and column openings, depth."""
    return np.array(
        [
            *np.asarray(wire.rotation),
            np.log(float(np.asarray(wire.standoff_per_pitch))),
            *np.asarray(wire.offset),
            np.log(float(np.asarray(wire.pupil_per_pitch))),
            *(float(np.asarray(part)) for part in (wire.row_open, wire.column_open, wire.depth_per_pitch)),
        ]
    )


def move(wire: Wire, steps: Float[np.ndarray, "10"] | Float[Array, "10"]) -> Wire:
    """Change the ten shape parameters, in the order of ``shape_vector``."""
    return eqx.tree_at(
        lambda w: (
            w.rotation,
            w.standoff_per_pitch,
            w.offset,
            w.pupil_per_pitch,
            w.row_open,
            w.column_open,
            w.depth_per_pitch,
        ),
        wire,
        (
            wire.rotation + steps[:3],
            wire.standoff_per_pitch * jnp.exp(steps[3]),
            wire.offset + steps[4:6],
            wire.pupil_per_pitch * jnp.exp(steps[6]),
            wire.row_open + steps[7],
            wire.column_open + steps[8],
            wire.depth_per_pitch + steps[9],
        ),
    )


@jax.jit
def wire_slopes(wire: Wire, ideal: Float[Array, "n 2"], scaled: Float[Array, "n 2"]) -> Slopes:
    """Values and derivatives at ideal image points, which lie at ``scaled`` positions of the sensor."""

    def seen_after(steps: Float[Array, "10"]) -> _Seen:
        return _seen(move(wire, steps), ideal)

    nothing = jnp.zeros(SHAPE_PARAMETERS)
    seen, by_shape = seen_after(nothing), jax.jacfwd(seen_after)(nothing)
    wave = waves(wire, slopes(wire, ideal))
    kappa, bessel, slit, slit_slope, powers = _factors(wire, seen)
    series = _series(wire, powers)
    # Without the barrier the compiler computes the Bessel functions anew for every sum below.
    wave, bessel, slit, slit_slope, powers, series = jax.lax.optimization_barrier(
        (wave, bessel, slit, slit_slope, powers, series)
    )
    crossed = jnp.where(jnp.all(jnp.asarray(wire.harmonics) != 0, axis=1), 0.5, 1.0)[:, None]
    both = crossed * slit[0] * slit[1]
    free = bessel[0] * series[:, 0] + bessel[1] * series[:, 1]
    size = both * free + _beside(wire, scaled)
    modulation = jnp.sum(size * wave, axis=(0, 1))
    by_periods = _by_periods(wire, size, wave)
    along = jnp.sum(free * wave, axis=0) * crossed
    by_open = jnp.stack([jnp.sum(along * slit_slope[i] * slit[1 - i], axis=0) for i in (0, 1)])
    by_ellipse, by_pupil = _by_footprint(wire, kappa, bessel, both, series, powers, wave)
    shape = (
        jnp.einsum("in,ink->kn", by_periods, by_shape.periods)
        + jnp.einsum("in,ink->kn", by_open + (1 + modulation) / seen.openings, by_shape.openings)
        + jnp.einsum("in,ink->kn", by_ellipse, by_shape.ellipse)
        + by_pupil * by_shape.log_pupil[:, None]
    )
    in_y, in_x = (legendre(scaled[:, 1 - i], jnp.shape(wire.baseline)[i]) for i in (0, 1))
    smooth = jnp.einsum("yx,yn,xn->n", jnp.asarray(wire.baseline), in_y, in_x)
    base = jnp.exp(smooth) * seen.openings[0] * seen.openings[1]
    return Slopes(1 + modulation, base, shape, wave, both * bessel[:2], powers)


def _seen(wire: Wire, ideal: Float[Array, "n 2"]) -> _Seen:
    slope, rotation = slopes(wire, ideal), panel_rotation(wire)
    right, down = (rotation[:2, i : i + 1] - slope * rotation[2, i] for i in (0, 1))
    ellipse = jnp.stack([right[i] * right[j] + down[i] * down[j] for i, j in ((0, 0), (0, 1), (1, 1))])
    periods = jnp.asarray(wire.offset)[:, None] + wire.standoff_per_pitch * slope
    return _Seen(periods, openings(wire, slope), ellipse, jnp.log(jnp.asarray(wire.pupil_per_pitch)))


def _factors(
    wire: Wire, seen: _Seen
) -> tuple[
    Float[Array, "harmonics n"],
    Float[Array, "3 harmonics n"],
    Float[Array, "2 harmonics n"],
    Float[Array, "2 harmonics n"],
    Float[Array, "degrees harmonics n"],
]:
    """kappa; G, z G' and z (z G')'; the slits' coefficients along X and Y; their slopes; Legendre powers."""
    n, m = (jnp.asarray(wire.harmonics)[:, i, None] for i in (0, 1))
    xx, xy, yy = seen.ellipse
    kappa = jnp.sqrt(n * n * xx + 2 * n * m * xy + m * m * yy)
    z = jnp.pi * jnp.exp(seen.log_pupil) * kappa
    j0, j1 = bessel_j0_j1(z)
    g = 2.0 * j1 / z
    second = 2.0 * (j0 - g)
    bessel = jnp.stack([g, second, -z * z * g - 2.0 * second])
    slit, slit_slope = [], []
    for order, width in zip((n, m), seen.openings, strict=True):
        sinc = jnp.sinc(order * width)
        slit.append(jnp.where(order == 0, 1.0, 2.0 * sinc))
        slit_slope.append(jnp.where(order == 0, 0.0, 2.0 * (jnp.cos(jnp.pi * order * width) - sinc) / width))
    powers = field_powers(wire, kappa, jnp.shape(wire.fields)[-1])
    return kappa, bessel, jnp.stack(slit), jnp.stack(slit_slope), powers


def _series(wire: Wire, powers: Float[Array, "degrees harmonics n"]) -> Float[Array, "2 2 harmonics n"]:
    """What the field coefficients make of the two carriers, by phase and carrier."""
    fields = jnp.moveaxis(jnp.asarray(wire.fields), 0, -1)[..., None]
    return sum((fields[:, :, d] * powers[d] for d in range(1, len(powers))), start=fields[:, :, 0] * powers[0])


def _beside(wire: Wire, scaled: Float[Array, "n 2"]) -> Float[Array, "2 harmonics n"]:
    """Amplitudes (cos, sin) that are polynomials over the sensor."""
    strongest, _, count_y, count_x = jnp.shape(wire.amplitudes)
    in_x, in_y = legendre(scaled[:, 0], count_x), legendre(scaled[:, 1], count_y)
    some = jnp.einsum("hpyx,yn,xn->phn", jnp.asarray(wire.amplitudes), in_y, in_x)
    return jnp.pad(some, ((0, 0), (0, jnp.shape(wire.harmonics)[0] - strongest), (0, 0)))


def _by_periods(
    wire: Wire, size: Float[Array, "2 harmonics n"], wave: Float[Array, "2 harmonics n"]
) -> Float[Array, "2 n"]:
    turned = size[1] * wave[0] - size[0] * wave[1]
    return 2 * jnp.pi * jnp.asarray(wire.harmonics).T @ turned


def _by_footprint(
    wire: Wire,
    kappa: Float[Array, "harmonics n"],
    bessel: Float[Array, "3 harmonics n"],
    both: Float[Array, "harmonics n"],
    series: Float[Array, "2 2 harmonics n"],
    powers: Float[Array, "degrees harmonics n"],
    wave: Float[Array, "2 harmonics n"],
) -> tuple[Float[Array, "3 n"], Float[Array, " n"]]:
    """Derivatives of the modulation by the ellipse (xx, xy, yy) and by the logarithm of the pupil."""
    by_log_z = both * jnp.sum((bessel[1] * series[:, 0] + bessel[2] * series[:, 1]) * wave, axis=0)
    # The corrections to the pupil's transform are series in kappa themselves.
    bent = _series(wire, _legendre_slopes(powers)) / jnp.asarray(wire.frequency)[:, 1:]
    by_kappa = by_log_z / kappa + both * jnp.sum((bessel[0] * bent[:, 0] + bessel[1] * bent[:, 1]) * wave, axis=0)
    n, m = jnp.asarray(wire.harmonics).T
    weights = jnp.stack([n * n / 2, n * m, m * m / 2])
    return weights @ (by_kappa / kappa), jnp.sum(by_log_z, axis=0)


def _legendre_slopes(powers: Float[Array, "degrees harmonics n"]) -> Float[Array, "degrees harmonics n"]:
    """P'_k = P'_(k-2) + (2 k - 1) P_(k-1)."""
    found = [jnp.zeros_like(powers[0]), jnp.ones_like(powers[0])]
    for k in range(2, len(powers)):
        found.append(found[k - 2] + (2 * k - 1) * powers[k - 1])
    return jnp.stack(found[: len(powers)])


def field_columns(found: Slopes, fields: Int[np.ndarray, "columns 4"]) -> Float[np.ndarray, "columns n"]:
    """Derivatives by field coefficients, a row of ``fields`` (harmonic, phase, carrier, degree) each."""
    if not len(fields):
        return np.zeros((0, len(found.whole)))
    wave, carrier, powers = (np.asarray(part) for part in (found.wave, found.carrier, found.powers))
    h, p, c, d = fields.T
    return wave[p, h] * carrier[c, h] * powers[d, h]
