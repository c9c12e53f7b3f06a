"""The wire's values and their derivatives, pixel by pixel, in closed form.

The modulation depends on the ten shape parameters through few numbers per pixel: the point where its ray meets the
panel (X, Y), two openings, three numbers of the footprint's ellipse, and the pupil. Sums over the harmonics are made
once per such number. Its derivatives by the shape parameters do not depend on the harmonics. That is several times
faster than automatic derivatives of the whole model, in either mode. Harmonics are summed in groups of one size, so
that each function is compiled once.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from udccal.fitting.wire.data import BLOCK, FlatNoise, Pixels, Weighed, over_blocks, weighed
from udccal.fitting.wire.parameters import Kind, Parameters
from udccal.models.bessel import bessel_j0_j1
from udccal.models.wire import LEAST_OPEN, Wire, field_powers, legendre, slits, waves

# Harmonics that are summed at once.
_GROUP = 50


class Rays(NamedTuple):
    """The numbers per pixel through which modulation and baseline depend on the shape.

    ``slope`` is (dX/dz, dY/dz). Panel coordinates in periods and openings are (X, Y); ``ellipse`` (xx, xy, yy) gives
    kappa of a harmonic.
    """

    slope: Float[np.ndarray, "2 n"]
    periods: Float[np.ndarray, "2 n"]
    openings: Float[np.ndarray, "2 n"]
    ellipse: Float[np.ndarray, "3 n"]


class Derivatives(NamedTuple):
    """At each pixel: 1 + modulation, exp(B), and derivatives relative to exp(B).

    ``shape`` is by the ten parameters of ``shape_vector``; ``wave``, ``carrier`` (slits' coefficients included) and
    ``powers`` are the factors of the linear field coefficients.
    """

    whole: Float[np.ndarray, " n"]
    base: Float[np.ndarray, " n"]
    shape: Float[np.ndarray, "10 n"]
    wave: Float[np.ndarray, "2 harmonics n"]
    carrier: Float[np.ndarray, "2 harmonics n"]
    powers: Float[np.ndarray, "degrees harmonics n"]


def _rotations(wire: Wire) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3 3 3"]]:
    """``R_panel_camera``, and its derivatives by the wire's own rotation vector."""
    (own, by_own), (mounted, _) = (
        cv2.Rodrigues(np.asarray(one, dtype=np.float64)) for one in (wire.rotation_rad, wire.geometry.rotation_rad)
    )
    return own @ mounted, by_own.reshape(3, 3, 3) @ mounted


def tilt_deg(wire: Wire) -> float:
    """Angle by which the camera's axis points below the panel's normal."""
    return float(np.rad2deg(np.arcsin(np.clip(_rotations(wire)[0][1, 2], -1.0, 1.0))))


def _plane(ideal: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "3 n"]:
    return np.stack([ideal[:, 0], ideal[:, 1], np.ones(len(ideal))])


def rays_at(wire: Wire, ideal: Float[np.ndarray, "n 2"]) -> Rays:
    """Where rays of ideal image points meet the panel."""
    rotation = _rotations(wire)[0]
    rays = rotation @ _plane(ideal)
    slope = rays[:2] / rays[2]
    straight = np.array([[wire.column_open], [wire.row_open]])
    width = np.maximum(straight - wire.depth_per_pitch * np.abs(slope), LEAST_OPEN)
    x, y = np.moveaxis(_axes(rotation, slope), 1, 0)
    ellipse = np.stack([(x * x).sum(axis=0), (x * y).sum(axis=0), (y * y).sum(axis=0)])
    periods = np.asarray(wire.offset_periods)[:, None] + wire.standoff_per_pitch * slope
    return Rays(slope, periods, width, ellipse)


def _axes(rotation: Float[np.ndarray, "3 3"], slope: Float[np.ndarray, "2 n"]) -> Float[np.ndarray, "2 2 n"]:
    """The pupil's x and y axes, seen along each ray on the panel (X, Y)."""
    return rotation[:2, :2].T[:, :, None] - slope * rotation[2, :2, None, None]


def with_harmonics(
    wire: Wire, harmonics: Float[np.ndarray, "harmonics 2"], ideal: Float[np.ndarray, "n 2"], sharpness: float = 1.0
) -> Wire:
    """The same shape with other harmonics (n, m) of a round pupil, and their ranges of kappa over a sample's points.

    ``sharpness`` is of the openings' edges: 1 for rectangular openings, 0 where only the first harmonics are left.
    """
    fields = np.zeros((len(harmonics), *np.shape(wire.fields)[1:]))
    # Normal blur of the edges multiplies harmonics by the exponential of -(n^2 + m^2).
    fields[:, 0, 0, 0] = sharpness ** np.maximum((harmonics**2).sum(axis=1) - 1, 0)
    # The wire's rays do not depend on its harmonics.
    ellipse = rays_at(wire, ideal[:: max(len(ideal) // BLOCK, 1)][:BLOCK]).ellipse
    n, m = harmonics.T
    seen = np.sqrt(np.stack([n * n, 2 * n * m, m * m], axis=1) @ ellipse)
    low, high = (part.reshape(len(harmonics)) for part in (seen.min(axis=1), seen.max(axis=1)))
    frequency = np.stack([(low + high) / 2, np.maximum(0.51 * (high - low), 0.01)], axis=1)
    return replace(wire, harmonics=harmonics, frequency=frequency, fields=fields)


def _groups(wire: Wire) -> Iterator[Wire]:
    """The wire's harmonics in groups of one size, the last filled up with harmonics of no amplitude.

    Amplitudes that no pupil explains are those of the first harmonics: only the first group has them.
    """
    free = wire.amplitudes if len(wire.amplitudes) else np.zeros((1, 2, 1, 1))
    for first in range(0, len(wire.harmonics), _GROUP):
        some = np.s_[first : first + _GROUP]
        fill = np.maximum(_GROUP - len(wire.harmonics[some]), 0)
        parts = (
            np.concatenate([np.asarray(part)[some], np.full((fill, *np.shape(part)[1:]), value)])
            for part, value in ((wire.harmonics, 1.0), (wire.frequency, 1.0), (wire.fields, 0.0))
        )
        harmonics, frequency, fields = parts
        amplitudes = free if first == 0 else np.zeros_like(free)
        yield replace(wire, harmonics=harmonics, frequency=frequency, fields=fields, amplitudes=amplitudes)


def values_at(
    wire: Wire, ideal: Float[np.ndarray, "n 2"], scaled: Float[np.ndarray, "n 2"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """1 + modulation and exp(B), whose product is the map, at points that fill whole blocks."""

    def at(ideal: Float[np.ndarray, "n 2"], scaled: Float[np.ndarray, "n 2"]) -> tuple[np.ndarray, np.ndarray]:
        rays = rays_at(wire, ideal)
        modulated = (sums[0] for sums, *_ in _of_groups(wire, rays, scaled))
        return sum(modulated, start=np.ones(len(ideal))), _base(wire, scaled, rays)

    return over_blocks(at, ideal, scaled)


def _of_groups(wire: Wire, rays: Rays, scaled: Float[np.ndarray, "n 2"]) -> list[tuple[np.ndarray, ...]]:
    """Return ``_group_derivatives`` of all groups, in single precision: twice as fast, and as accurate as its J0."""
    rays = rays._replace(periods=rays.periods - np.round(rays.periods))
    with jax.enable_x64(False):
        return [jax.tree.map(np.asarray, _group_derivatives(some, rays, scaled)) for some in _groups(wire)]


def _base(wire: Wire, scaled: Float[np.ndarray, "n 2"], rays: Rays) -> Float[np.ndarray, " n"]:
    """exp(B): the shading times the openings."""
    in_x, in_y = np.polynomial.legendre.legvander(scaled.T, len(wire.baseline) - 1)
    return np.exp(((in_y @ wire.baseline) * in_x).sum(axis=1)) * rays.openings.prod(axis=0)


def expected_of(wire: Wire, gains: Float[np.ndarray, " sites"], pixels: Pixels) -> Float[np.ndarray, " n"]:
    """The signal of a sample by the model, in CFA-balanced units."""
    whole, base = values_at(wire, pixels.ideal, pixels.scaled)
    return whole * base * gains[pixels.site]


def weighed_at(parameters: Parameters, x: Float[np.ndarray, " n"], pixels: Pixels, noise: FlatNoise) -> Weighed:
    """A sample weighted by the wire and the gains of these parameters."""
    return weighed(pixels, expected_of(parameters.wire(x), parameters.gains(x), pixels), noise)


def wire_derivatives(wire: Wire, ideal: Float[np.ndarray, "n 2"], scaled: Float[np.ndarray, "n 2"]) -> Derivatives:
    """Values and derivatives at ideal image points of one block, which lie at ``scaled`` positions of the sensor."""
    rays = rays_at(wire, ideal)
    found = _of_groups(wire, rays, scaled)
    sums = sum((one[0] for one in found), start=np.zeros((9, len(ideal))))
    count = len(wire.harmonics)
    wave, carrier, powers = (
        np.concatenate(parts, axis=1)[:, :count] for parts in zip(*(one[1:] for one in found), strict=True)
    )
    sums[0] += 1.0
    sums[3:5] += sums[0] / rays.openings
    return Derivatives(
        sums[0], _base(wire, scaled, rays), _by_shape(wire, ideal, rays, sums[1:]), wave, carrier, powers
    )


def _by_shape(
    wire: Wire, ideal: Float[np.ndarray, "n 2"], rays: Rays, by: Float[np.ndarray, "8 n"]
) -> Float[np.ndarray, "10 n"]:
    """Derivatives by the shape, from those ``by`` periods (2), openings (2), ellipse (3) and logarithm of the pupil."""
    rotation, turns = _rotations(wire)
    plane, slope = _plane(ideal), rays.slope
    by_periods, by_open, (xx, xy, yy) = by[:2], by[2:4], by[4:7]
    # An opening at its least size does not change.
    by_open = np.where(rays.openings > LEAST_OPEN, by_open, 0.0)
    x, y = np.moveaxis(_axes(rotation, slope), 1, 0)
    by_axes = np.stack([2 * xx * x + xy * y, 2 * yy * y + xy * x], axis=1)
    by_slope = wire.standoff_per_pitch * by_periods - wire.depth_per_pitch * np.sign(slope) * by_open
    by_slope = by_slope - np.tensordot(rotation[2, :2], by_axes, 1)
    away = (rotation @ plane)[2]
    rows = []
    for turn in turns:
        moved = turn @ plane
        along = ((moved[:2] - slope * moved[2]) / away * by_slope).sum(axis=0)
        rows.append(along + (_axes(turn, slope) * by_axes).sum(axis=(0, 1)))
    rows += [wire.standoff_per_pitch * (by_periods * slope).sum(axis=0), *by_periods, by[7]]
    return np.stack([*rows, by_open[1], by_open[0], -(by_open * np.abs(slope)).sum(axis=0)])


@jax.jit
def _group_derivatives(
    wire: Wire, rays: Rays, scaled: Float[Array, "n 2"]
) -> tuple[Float[Array, "9 n"], Float[Array, "2 group n"], Float[Array, "2 group n"], Float[Array, "degrees group n"]]:
    """Modulation and its derivatives by periods, openings, ellipse and log pupil; waves, carriers and powers."""
    harmonics = jnp.asarray(wire.harmonics)
    wave = waves(wire, rays.periods)
    kappa, bessel, slit, slit_slope, powers = _factors(wire, rays)
    series = _series(wire, powers)
    # Without the barrier the compiler computes the Bessel functions anew for every sum below.
    wave, bessel, slit, slit_slope, powers, series = jax.lax.optimization_barrier(
        (wave, bessel, slit, slit_slope, powers, series)
    )
    crossed = jnp.where(jnp.all(harmonics != 0, axis=1), 0.5, 1.0)[:, None]
    both = crossed * slit[0] * slit[1]
    free = bessel[0] * series[:, 0] + bessel[1] * series[:, 1]
    size = both * free + _beside(wire, scaled)
    by_periods = 2 * jnp.pi * harmonics.T @ (size[1] * wave[0] - size[0] * wave[1])
    along = jnp.sum(free * wave, axis=0) * crossed
    by_open = jnp.stack([jnp.sum(along * slit_slope[i] * slit[1 - i], axis=0) for i in (0, 1)])
    by_ellipse, by_pupil = _by_footprint(wire, kappa, bessel, both, series, powers, wave)
    modulated = jnp.sum(size * wave, axis=(0, 1))[None]
    sums = jnp.concatenate([modulated, by_periods, by_open, by_ellipse, by_pupil])
    return sums, wave, both * bessel[:2], powers


def _factors(wire: Wire, rays: Rays) -> tuple[Array, Array, Array, Array, Array]:
    """kappa; G, z G' and z (z G')'; the slits' coefficients along X and Y; their slopes; Legendre powers."""
    n, m = (jnp.asarray(wire.harmonics)[:, i, None] for i in (0, 1))
    xx, xy, yy = jnp.asarray(rays.ellipse)
    kappa = jnp.sqrt(n * n * xx + 2 * n * m * xy + m * m * yy)
    z = jnp.pi * wire.footprint_per_pitch * kappa
    j0, j1 = bessel_j0_j1(z)
    g = 2.0 * j1 / z
    second = 2.0 * (j0 - g)
    bessel = jnp.stack([g, second, -z * z * g - 2.0 * second])
    slit, slit_slope = slits(wire, jnp.asarray(rays.openings))
    return kappa, bessel, slit, slit_slope, field_powers(wire, kappa, jnp.shape(wire.fields)[-1])


def _series(wire: Wire, powers: Float[Array, "degrees harmonics n"]) -> Float[Array, "2 2 harmonics n"]:
    """Sums of the field coefficients times the Legendre powers, by phase and carrier."""
    fields = jnp.moveaxis(jnp.asarray(wire.fields), 0, -1)[..., None]
    return sum((fields[:, :, d] * powers[d] for d in range(1, len(powers))), start=fields[:, :, 0] * powers[0])


def _beside(wire: Wire, scaled: Float[Array, "n 2"]) -> Float[Array, "2 harmonics n"]:
    """Amplitudes (cos, sin) that are polynomials over the sensor."""
    strongest, _, count_y, count_x = jnp.shape(wire.amplitudes)
    in_x, in_y = legendre(scaled[:, 0], count_x), legendre(scaled[:, 1], count_y)
    some = jnp.einsum("hpyx,yn,xn->phn", jnp.asarray(wire.amplitudes), in_y, in_x)
    return jnp.pad(some, ((0, 0), (0, jnp.shape(wire.harmonics)[0] - strongest), (0, 0)))


def _by_footprint(
    wire: Wire, kappa: Array, bessel: Array, both: Array, series: Array, powers: Array, wave: Array
) -> tuple[Float[Array, "3 n"], Float[Array, "1 n"]]:
    """Derivatives of the modulation by the ellipse (xx, xy, yy) and by the logarithm of the pupil."""
    by_log_z = both * jnp.sum((bessel[1] * series[:, 0] + bessel[2] * series[:, 1]) * wave, axis=0)
    # The corrections to the pupil's transform are themselves series in kappa; P'_k = P'_(k-2) + (2 k - 1) P_(k-1).
    bent = [jnp.zeros_like(powers[0]), jnp.ones_like(powers[0])]
    for k in range(2, len(powers)):
        bent.append(bent[k - 2] + (2 * k - 1) * powers[k - 1])
    curved = _series(wire, jnp.stack(bent[: len(powers)])) / jnp.asarray(wire.frequency)[:, 1:]
    by_kappa = by_log_z / kappa + both * jnp.sum((bessel[0] * curved[:, 0] + bessel[1] * curved[:, 1]) * wave, axis=0)
    n, m = jnp.asarray(wire.harmonics).T
    return jnp.stack([n * n / 2, n * m, m * m / 2]) @ (by_kappa / kappa), jnp.sum(by_log_z, axis=0, keepdims=True)


def block_jacobian(
    parameters: Parameters,
    wire: Wire,
    ideal: Float[np.ndarray, "n 2"],
    scaled: Float[np.ndarray, "n 2"],
    site: Int[np.ndarray, " n"],
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, "parameters n"]]:
    """1 + modulation, exp(B), and derivatives by the parameters relative to exp(B) and the gain, for one block."""
    found = wire_derivatives(wire, ideal, scaled)
    in_x, in_y = np.polynomial.legendre.legvander(scaled.T, np.shape(wire.baseline)[0] - 1).transpose(0, 2, 1)
    # The baseline acts on everything: the change of exp(B) (1 + M), relative to exp(B), is (1 + M) dB.
    _, _, degree_y, degree_x = parameters.indices(Kind.SHADING)
    rows = [in_y[degree_y] * in_x[degree_x] * found.whole]
    of_site = np.append(np.eye(parameters.sites - 1), -np.ones((parameters.sites - 1, 1)), axis=1)[:, site]
    rows.append(of_site[parameters.indices(Kind.SITE)[0]] * found.whole)
    harmonic, phase, degree_y, degree_x = parameters.indices(Kind.AMPLITUDE)
    rows.append(found.wave[phase, harmonic] * in_y[degree_y] * in_x[degree_x])
    harmonic, phase, carrier, degree = parameters.indices(Kind.FIELD)
    rows.append(found.wave[phase, harmonic] * found.carrier[carrier, harmonic] * found.powers[degree, harmonic])
    rows.append(found.shape[parameters.indices(Kind.SHAPE)[0]])
    return found.whole, found.base, np.concatenate(rows)
