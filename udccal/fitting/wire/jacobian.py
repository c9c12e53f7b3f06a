"""The wire's values and their derivatives, pixel by pixel, and the equations of a sample.

The modulation depends on the ten shape parameters through few numbers per pixel: the point where its ray meets the
panel (X, Y), two openings, three numbers of the footprint's ellipse, and the pupil. Sums over the harmonics are made
once per such number, in closed form. Derivatives of these numbers by the shape parameters do not depend on the
harmonics and are automatic. That is several times faster than automatic derivatives of the whole model, in either mode.
Harmonics are summed in groups of one size, so that each function is compiled once.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple, final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from udccal.fitting.engine.gaussian import Prior
from udccal.fitting.engine.least_squares import Blocks, Step
from udccal.fitting.wire.data import BLOCK, FlatNoise, Pixels, Weighed, weighed
from udccal.fitting.wire.parameters import Kind, Parameters, shape_vector
from udccal.models.arrays import Arrayish
from udccal.models.bessel import bessel_j0_j1
from udccal.models.geometry import rotation_matrix
from udccal.models.wire import LEAST_OPEN, Wire, field_powers, legendre, slits, waves

# Tiles of the sensor, down and across, whose residuals are tested as a whole.
TILES = (6, 8)
# Least residual variance in units of the noise's, so that quotients by it stay finite.
LEAST_VARIANCE = 1e-12
# Harmonics that are summed at once.
_GROUP = 50


class Rays(NamedTuple):
    """The numbers per pixel through which modulation and baseline depend on the shape.

    Panel coordinates in periods and openings are (X, Y); ``ellipse`` (xx, xy, yy) gives kappa of a harmonic.
    """

    periods: Float[Arrayish, "2 *n"]
    openings: Float[Arrayish, "2 *n"]
    ellipse: Float[Arrayish, "3 *n"]


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


@jax.jit
def _rays(shape: Float[Array, "10"], mounted: Float[Array, "3"], ideal: Float[Array, "n 2"]) -> Rays:
    """Where rays of ideal image points meet the panel, by ``shape_vector`` and the geometry's rotation."""
    rotation = rotation_matrix(shape[:3]) @ rotation_matrix(mounted)
    ray = rotation @ jnp.insert(ideal, 2, 1.0, axis=1).T
    slope = ray[:2] / ray[2]
    # The pupil's axes, seen along each ray on the panel.
    x, y = rotation[:2, :2, None] - slope[:, None] * rotation[2, :2, None]
    ellipse = jnp.stack([(x * x).sum(axis=0), (x * y).sum(axis=0), (y * y).sum(axis=0)])
    openings = jnp.maximum(shape[8:6:-1, None] - shape[9] * jnp.abs(slope), LEAST_OPEN)
    return Rays(shape[4:6, None] + jnp.exp(shape[3]) * slope, openings, ellipse)


_rays_by_shape = jax.jit(jax.jacfwd(_rays))


def rays_at(wire: Wire, pixels: Pixels) -> Rays:
    """Where the pixels' rays meet the panel."""
    shape, mounted = shape_vector(wire), np.asarray(wire.geometry.rotation_rad)
    return pixels.by_block(lambda block: _rays(shape, mounted, block.ideal))


def with_harmonics(
    wire: Wire, harmonics: Float[np.ndarray, "harmonics 2"], pixels: Pixels, sharpness: float = 1.0
) -> Wire:
    """The same shape with other harmonics (n, m) of a round pupil, and their ranges of kappa over a sample.

    ``sharpness`` is of the openings' edges: 1 for rectangular openings, 0 where only the first harmonics are left.
    """
    fields = np.zeros((len(harmonics), *np.shape(wire.fields)[1:]))
    # Normal blur of the edges multiplies harmonics by the exponential of -(n^2 + m^2).
    fields[:, 0, 0, 0] = sharpness ** np.maximum((harmonics**2).sum(axis=1) - 1, 0)
    ellipse = rays_at(wire, pixels.thinned(BLOCK)).ellipse
    n, m = harmonics.T
    seen = np.sqrt(np.stack([n * n, 2 * n * m, m * m], axis=1) @ ellipse)
    low, high = seen.min(axis=1), seen.max(axis=1)
    frequency = np.stack([(low + high) / 2, np.maximum(0.51 * (high - low), 0.01)], axis=1)
    return replace(wire, harmonics=harmonics, frequency=frequency, fields=fields)


def values_at(wire: Wire, pixels: Pixels) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """1 + modulation and exp(B), whose product is the map."""

    def at(block: Pixels) -> tuple[np.ndarray, np.ndarray]:
        rays = rays_at(wire, block)
        modulated = (sums[0] for sums, *_ in _of_groups(wire, rays, block.scaled))
        return sum(modulated, start=np.ones(len(block.value))), _base(wire, rays, block.scaled)

    return pixels.by_block(at)


def _of_groups(wire: Wire, rays: Rays, scaled: Float[np.ndarray, "n 2"]) -> list[tuple[np.ndarray, ...]]:
    """``_group_derivatives`` of harmonics in groups of one size, the last filled up with some of no amplitude.

    Single precision is as accurate as its J0. Amplitudes that no pupil explains are those of the first harmonics: only
    the first group has them.
    """
    rays = rays._replace(periods=rays.periods - np.round(rays.periods))
    free, found = wire.amplitudes if len(wire.amplitudes) else np.zeros((1, 2, 1, 1)), []
    for first in range(0, len(wire.harmonics), _GROUP):
        some = np.s_[first : first + _GROUP]
        fill = _GROUP - len(wire.harmonics[some])
        harmonics, frequency, fields = (
            np.concatenate([np.asarray(part)[some], np.full((fill, *np.shape(part)[1:]), value)])
            for part, value in ((wire.harmonics, 1.0), (wire.frequency, 1.0), (wire.fields, 0.0))
        )
        group = replace(wire, harmonics=harmonics, frequency=frequency, fields=fields, amplitudes=free)
        # A wire may hold JAX's arrays, which the setting of single precision leaves as they are.
        single = jax.tree.map(lambda part: np.asarray(part, np.float32), (group, rays, scaled))
        with jax.enable_x64(False):
            found.append(jax.tree.map(np.asarray, _group_derivatives(*single)))
        free = np.zeros_like(free)
    return found


def _base(wire: Wire, rays: Rays, scaled: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
    """exp(B): the shading times the openings."""
    in_x, in_y = np.polynomial.legendre.legvander(scaled.T, len(wire.baseline) - 1)
    return np.exp(((in_y @ wire.baseline) * in_x).sum(axis=1)) * rays.openings.prod(axis=0)


def expected_of(wire: Wire, gains: Float[np.ndarray, " sites"], pixels: Pixels) -> Float[np.ndarray, " n"]:
    """The signal of a sample by the model, in CFA-balanced units."""
    whole, base = values_at(wire, pixels)
    return whole * base * gains[pixels.site]


def weighed_at(parameters: Parameters, x: Float[np.ndarray, " n"], pixels: Pixels, noise: FlatNoise) -> Weighed:
    """A sample weighted by the wire and the gains of these parameters."""
    return weighed(pixels, expected_of(parameters.wire(x), parameters.gains(x), pixels), noise)


def wire_derivatives(wire: Wire, block: Pixels) -> Derivatives:
    """Values and derivatives at the pixels of one block."""
    rays = rays_at(wire, block)
    found = _of_groups(wire, rays, block.scaled)
    sums = sum((one[0] for one in found), start=np.zeros((9, len(block.value))))
    wave, carrier, powers = (
        np.concatenate(parts, axis=1)[:, : len(wire.harmonics)]
        for parts in zip(*(one[1:] for one in found), strict=True)
    )
    sums[0] += 1.0
    sums[3:5] += sums[0] / rays.openings
    moved = np.concatenate(_rays_by_shape(shape_vector(wire), np.asarray(wire.geometry.rotation_rad), block.ideal))
    shape = np.einsum("kn,knp->pn", sums[1:8], moved)
    # The pupil acts on the harmonics alone.
    shape[6] += sums[8]
    return Derivatives(sums[0], _base(wire, rays, block.scaled), shape, wave, carrier, powers)


@jax.jit
def _group_derivatives(
    wire: Wire, rays: Rays, scaled: Float[Array, "n 2"]
) -> tuple[Float[Array, "9 n"], Float[Array, "2 group n"], Float[Array, "2 group n"], Float[Array, "degrees group n"]]:
    """Modulation and its derivatives by periods, openings, ellipse and log pupil; waves, carriers and powers."""
    harmonics = jnp.asarray(wire.harmonics)
    n, m = harmonics.T[..., None]
    xx, xy, yy = jnp.asarray(rays.ellipse)
    kappa = jnp.sqrt(n * n * xx + 2 * n * m * xy + m * m * yy)
    z = jnp.pi * wire.footprint_per_pitch * kappa
    j0, j1 = bessel_j0_j1(z)
    g = 2.0 * j1 / z
    second = 2.0 * (j0 - g)
    # G, z G' and z (z G')' of the pupil's transform.
    bessel = jnp.stack([g, second, -z * z * g - 2.0 * second])
    powers = field_powers(wire, kappa, jnp.shape(wire.fields)[-1])
    slit, slit_slope = slits(wire, jnp.asarray(rays.openings))
    # Without the barrier the compiler computes the Bessel functions anew for every sum below.
    wave, bessel, slit, slit_slope, powers, series = jax.lax.optimization_barrier(
        (waves(wire, rays.periods), bessel, slit, slit_slope, powers, _series(wire, powers))
    )
    crossed = jnp.where((n != 0) & (m != 0), 0.5, 1.0)
    both = crossed * slit[0] * slit[1]
    free = bessel[0] * series[:, 0] + bessel[1] * series[:, 1]
    size = both * free + _beside(wire, scaled)
    by_periods = 2 * jnp.pi * harmonics.T @ (size[1] * wave[0] - size[0] * wave[1])
    along = jnp.sum(free * wave, axis=0) * crossed
    by_open = jnp.stack([jnp.sum(along * slit_slope[i] * slit[1 - i], axis=0) for i in (0, 1)])
    by_log_z = both * jnp.sum((bessel[1] * series[:, 0] + bessel[2] * series[:, 1]) * wave, axis=0)
    # The corrections to the pupil's transform are themselves series in kappa; P'_k = P'_(k-2) + (2 k - 1) P_(k-1).
    bent = [jnp.zeros_like(powers[0]), jnp.ones_like(powers[0])]
    for k in range(2, len(powers)):
        bent.append(bent[k - 2] + (2 * k - 1) * powers[k - 1])
    curved = _series(wire, jnp.stack(bent[: len(powers)])) / jnp.asarray(wire.frequency)[:, 1:]
    by_kappa = by_log_z / kappa + both * jnp.sum((bessel[0] * curved[:, 0] + bessel[1] * curved[:, 1]) * wave, axis=0)
    by_ellipse = jnp.stack([n * n / 2, n * m, m * m / 2])[..., 0] @ (by_kappa / kappa)
    modulated, by_pupil = jnp.sum(size * wave, axis=(0, 1))[None], jnp.sum(by_log_z, axis=0)[None]
    sums = jnp.concatenate([modulated, by_periods, by_open, by_ellipse, by_pupil])
    return sums, wave, both * bessel[:2], powers


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


def block_jacobian(
    parameters: Parameters, wire: Wire, block: Pixels
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, "parameters n"]]:
    """1 + modulation, exp(B), and derivatives by the parameters relative to exp(B) and the gain, for one block."""
    found = wire_derivatives(wire, block)
    in_x, in_y = np.polynomial.legendre.legvander(block.scaled.T, np.shape(wire.baseline)[0] - 1).transpose(0, 2, 1)
    # The baseline acts on everything: the change of exp(B) (1 + M), relative to exp(B), is (1 + M) dB.
    _, _, degree_y, degree_x = parameters.indices(Kind.SHADING)
    rows = [in_y[degree_y] * in_x[degree_x] * found.whole]
    of_site = np.append(np.eye(parameters.sites - 1), -np.ones((parameters.sites - 1, 1)), axis=1)[:, block.site]
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
        matrix, by_tile, chi2 = np.zeros((size, size)), np.zeros((TILES[0] * TILES[1], size)), 0.0
        for block in self.pixels.blocks():
            whole, base, rows = block_jacobian(self.parameters, wire, block)
            level, root = base * gains[block.site], np.sqrt(block.weight)
            errors, rows = (block.value - whole * level) * root, rows * (root * level)
            matrix += rows @ rows.T
            # A block is some rows of the sensor, which cross few of the tiles.
            tile = tile_numbers(block.scaled)
            crossed = np.unique(tile)
            by_tile[crossed] += np.where(tile == crossed[:, None], errors, 0.0) @ rows.T
            chi2 += float(errors @ errors)
        return matrix, by_tile, chi2

    def moved(self, place: Float[np.ndarray, " n"], step: Step) -> Float[np.ndarray, " n"]:
        """The place after a step."""
        return place + step.shared


def tile_numbers(scaled: Float[np.ndarray, "n 2"]) -> Int[np.ndarray, " n"]:
    """Number of the sensor's tile in which each position lies."""
    x, y = (np.clip((0.5 * (scaled[:, i] + 1) * n).astype(np.int64), 0, n - 1) for i, n in enumerate(TILES[::-1]))
    return np.asarray(y * TILES[1] + x)
