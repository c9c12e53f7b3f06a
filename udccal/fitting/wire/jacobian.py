"""The wire's values and their derivatives, pixel by pixel, in closed form and summed up to normal equations.

The modulation depends on the ten shape parameters through few numbers per pixel: the point where its ray meets the
panel (X, Y), two openings, three numbers of the footprint's ellipse, and the pupil. Sums over the harmonics are made
once per such number. Its derivatives by the shape parameters do not depend on the harmonics. That is several times
faster than automatic derivatives of the whole model, in either mode.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple, final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from udccal.fitting.engine.gaussian import Prior
from udccal.fitting.engine.least_squares import Blocks, Step
from udccal.fitting.wire.data import BLOCK, FlatNoise, Pixels, Weighed, blocks, over_blocks, weighed
from udccal.fitting.wire.parameters import Kind, Parameters, shape_vector, with_shape
from udccal.models.bessel import bessel_j0_j1
from udccal.models.wire import (
    Wire,
    field_powers,
    legendre,
    log_baseline,
    modulation,
    openings,
    panel_rotation,
    slopes,
    waves,
)

# Tiles of the sensor, down and across, whose residuals are tested as a whole.
TILES = (6, 8)
# Least residual variance in units of the noise's, so that quotients by it stay finite.
LEAST_VARIANCE = 1e-12


class Rays(NamedTuple):
    """The numbers per pixel through which modulation and baseline depend on the shape.

    Panel coordinates in periods and openings are (X, Y); ``ellipse`` (xx, xy, yy) gives kappa of a harmonic.
    """

    periods: Float[Array, "2 n"]
    openings: Float[Array, "2 n"]
    ellipse: Float[Array, "3 n"]
    log_pupil: Float[Array, "1 n"]


class Derivatives(NamedTuple):
    """At each pixel: 1 + modulation, exp(B), and derivatives relative to exp(B).

    ``shape`` is by the ten parameters of ``shape_vector``; ``wave``, ``carrier`` (slits' coefficients included) and
    ``powers`` are the factors of the linear field coefficients.
    """

    whole: Float[Array, " n"]
    base: Float[Array, " n"]
    shape: Float[Array, "10 n"]
    wave: Float[Array, "2 harmonics n"]
    carrier: Float[Array, "2 harmonics n"]
    powers: Float[Array, "degrees harmonics n"]


@jax.jit
def _rays(wire: Wire, ideal: Float[Array, "n 2"]) -> Rays:
    slope, rotation = slopes(wire, ideal), panel_rotation(wire)
    right, down = (rotation[:2, i : i + 1] - slope * rotation[2, i] for i in (0, 1))
    ellipse = jnp.stack([right[i] * right[j] + down[i] * down[j] for i, j in ((0, 0), (0, 1), (1, 1))])
    periods = jnp.asarray(wire.offset_periods)[:, None] + wire.standoff_per_pitch * slope
    log_pupil = jnp.log(jnp.asarray(wire.footprint_per_pitch)) + jnp.zeros_like(slope[:1])
    return Rays(periods, openings(wire, slope), ellipse, log_pupil)


def rays_at(wire: Wire, ideal: Float[np.ndarray, "n 2"]) -> Rays:
    """Where rays of ideal image points, which fill whole blocks, meet the panel."""
    return over_blocks(partial(_rays, wire), ideal)


def with_harmonics(wire: Wire, harmonics: Float[np.ndarray, "harmonics 2"], ideal: Float[np.ndarray, "n 2"]) -> Wire:
    """The same shape with other harmonics of a round pupil.

    Args:
        wire: gives the shape.
        harmonics: orders (n, m) along X and Y.
        ideal: undistorted image points of a sample of the sensor, which fill whole blocks.

    Returns:
        the wire with these harmonics and their ranges of kappa over the sample.
    """
    fields = np.zeros((len(harmonics), *np.shape(wire.fields)[1:]))
    fields[:, 0, 0, 0] = 1.0
    # The wire's rays do not depend on its harmonics.
    ellipse = rays_at(wire, ideal[:: len(ideal) // BLOCK][:BLOCK]).ellipse
    n, m = harmonics.T
    seen = np.sqrt(np.stack([n * n, 2 * n * m, m * m], axis=1) @ np.asarray(ellipse))
    low, high = (part.reshape(len(harmonics)) for part in (seen.min(axis=1), seen.max(axis=1)))
    frequency = np.stack([(low + high) / 2, np.maximum(0.51 * (high - low), 0.01)], axis=1)
    return replace(wire, harmonics=harmonics, frequency=frequency, fields=fields)


@jax.jit
def _values(
    wire: Wire, ideal: Float[Array, "n 2"], scaled: Float[Array, "n 2"]
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    slope = slopes(wire, ideal)
    return 1 + modulation(wire, slope, scaled), jnp.exp(log_baseline(wire, scaled, slope))


def values_at(
    wire: Wire, ideal: Float[np.ndarray, "n 2"], scaled: Float[np.ndarray, "n 2"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """1 + modulation and exp(B), whose product is the map, at points that fill whole blocks."""
    return over_blocks(partial(_values, wire), ideal, scaled)


def expected_of(wire: Wire, gains: Float[np.ndarray, " sites"], pixels: Pixels) -> Float[np.ndarray, " n"]:
    """The signal of a sample by the model.

    Args:
        wire: modulation and shading.
        gains: of the CFA sites.
        pixels: the sample.

    Returns:
        one signal per pixel, in CFA-balanced units.
    """
    whole, base = values_at(wire, pixels.ideal, pixels.scaled)
    return whole * base * gains[pixels.site]


def weighed_at(parameters: Parameters, x: Float[np.ndarray, " n"], pixels: Pixels, noise: FlatNoise) -> Weighed:
    """A sample weighted by the wire and the gains of these parameters."""
    return weighed(pixels, expected_of(parameters.wire(x), parameters.gains(x), pixels), noise)


@jax.jit
def wire_derivatives(wire: Wire, ideal: Float[Array, "n 2"], scaled: Float[Array, "n 2"]) -> Derivatives:
    """Values and derivatives at ideal image points, which lie at ``scaled`` positions of the sensor."""

    def rays_after(step: Float[Array, "10"]) -> Rays:
        return _rays(with_shape(wire, shape_vector(wire) + step), ideal)

    nothing = jnp.zeros(10)
    rays, by_shape = rays_after(nothing), jax.jacfwd(rays_after)(nothing)
    wave = waves(wire, slopes(wire, ideal))
    kappa, bessel, slit, slit_slope, powers = _factors(wire, rays)
    series = _series(wire, powers)
    # Without the barrier the compiler computes the Bessel functions anew for every sum below.
    wave, bessel, slit, slit_slope, powers, series = jax.lax.optimization_barrier(
        (wave, bessel, slit, slit_slope, powers, series)
    )
    crossed = jnp.where(jnp.all(jnp.asarray(wire.harmonics) != 0, axis=1), 0.5, 1.0)[:, None]
    both = crossed * slit[0] * slit[1]
    free = bessel[0] * series[:, 0] + bessel[1] * series[:, 1]
    size = both * free + _beside(wire, scaled)
    whole = 1 + jnp.sum(size * wave, axis=(0, 1))
    by_periods = 2 * jnp.pi * jnp.asarray(wire.harmonics).T @ (size[1] * wave[0] - size[0] * wave[1])
    along = jnp.sum(free * wave, axis=0) * crossed
    by_open = jnp.stack([jnp.sum(along * slit_slope[i] * slit[1 - i], axis=0) for i in (0, 1)])
    by_ellipse, by_pupil = _by_footprint(wire, kappa, bessel, both, series, powers, wave)
    by_rays = Rays(by_periods, by_open + whole / rays.openings, by_ellipse, by_pupil)
    parts = [jnp.einsum("in,ink->kn", one, by) for one, by in zip(by_rays, by_shape, strict=True)]
    shape = jnp.sum(jnp.stack(parts), axis=0)
    base = jnp.exp(log_baseline(wire, scaled, slopes(wire, ideal)))
    return Derivatives(whole, base, shape, wave, both * bessel[:2], powers)


def _factors(wire: Wire, rays: Rays) -> tuple[Array, Array, Array, Array, Array]:
    """kappa; G, z G' and z (z G')'; the slits' coefficients along X and Y; their slopes; Legendre powers."""
    n, m = (jnp.asarray(wire.harmonics)[:, i, None] for i in (0, 1))
    xx, xy, yy = rays.ellipse
    kappa = jnp.sqrt(n * n * xx + 2 * n * m * xy + m * m * yy)
    z = jnp.pi * jnp.exp(rays.log_pupil) * kappa
    j0, j1 = bessel_j0_j1(z)
    g = 2.0 * j1 / z
    second = 2.0 * (j0 - g)
    bessel = jnp.stack([g, second, -z * z * g - 2.0 * second])
    order, width = jnp.stack([n, m]), rays.openings[:, None]
    sinc = jnp.sinc(order * width)
    slit = jnp.where(order == 0, 1.0, 2.0 * sinc)
    slit_slope = jnp.where(order == 0, 0.0, 2.0 * (jnp.cos(jnp.pi * order * width) - sinc) / width)
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
    found = jax.tree.map(np.asarray, wire_derivatives(wire, ideal, scaled))
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


@final
@dataclass(frozen=True)
class WireProblem:
    """The likelihood of the parameters by a sample of weighted pixels.

    The scale of the noise is estimated with them, so that the prior's weight does not depend on how well PRNU is
    known. With the scale profiled out, minus twice the log likelihood is dof ln(chi-squared / dof).
    """

    name: str
    parameters: Parameters
    pixels: Pixels
    prior: Prior

    def equations_at(self, place: Float[np.ndarray, " n"]) -> Blocks:
        """Cost and normal equations in units of the residual variance."""
        matrix, by_tile, chi2 = self.sums(place)
        used, variance = self.pixels.used, self.variance(chi2)
        cost = max(used - len(place), 1) * float(np.log(variance))
        by_data = Blocks.dense(cost, used, matrix / variance, by_tile.sum(axis=0) / variance)
        return by_data.with_prior(self.prior, place)

    def variance(self, chi2: float) -> float:
        """Variance of the residuals in units of the noise's."""
        return chi2 / max(self.pixels.used - len(self.prior.mean), 1) + LEAST_VARIANCE

    def sums(
        self, place: Float[np.ndarray, " n"]
    ) -> tuple[Float[np.ndarray, "n n"], Float[np.ndarray, "tiles n"], float]:
        """Information by the pixels' weights, the right side by tile, and chi-squared."""
        wire, gains, size = self.parameters.wire(place), self.parameters.gains(place), len(place)
        tiles = np.arange(TILES[0] * TILES[1])[:, None]
        matrix, by_tile, chi2, p = np.zeros((size, size)), np.zeros((len(tiles), size)), 0.0, self.pixels
        for ideal, scaled, site, value, weight in blocks(p.ideal, p.scaled, p.site, p.value, p.weight):
            whole, base, rows = block_jacobian(self.parameters, wire, ideal, scaled, site)
            level, root = base * gains[site], np.sqrt(weight)
            errors, rows = (value - whole * level) * root, rows * (root * level)
            matrix += rows @ rows.T
            by_tile += np.where(tile_numbers(scaled) == tiles, errors, 0.0) @ rows.T
            chi2 += float(errors @ errors)
        return matrix, by_tile, chi2

    def moved(self, place: Float[np.ndarray, " n"], step: Step) -> Float[np.ndarray, " n"]:
        """The place after a step."""
        return place + step.shared


def tile_numbers(scaled: Float[np.ndarray, "n 2"]) -> Int[np.ndarray, " n"]:
    """Number of the sensor's tile in which each position lies."""
    x, y = (np.clip((0.5 * (scaled[:, i] + 1) * n).astype(np.int64), 0, n - 1) for i, n in enumerate(TILES[::-1]))
    return np.asarray(y * TILES[1] + x)
