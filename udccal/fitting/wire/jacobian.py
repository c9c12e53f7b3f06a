"""The wire's values and their derivatives, pixel by pixel, and the equations of a sample.

The modulation depends on the ten shape parameters through few numbers per pixel: the point where its ray meets the
panel (X, Y), two openings, three numbers of the footprint's ellipse, and the pupil. Sums over the harmonics are made
once per such number, in closed form. Derivatives of these numbers by the shape parameters do not depend on the
harmonics and are automatic. That is several times faster than automatic derivatives of the whole model, in either mode.
The sums run from harmonic to harmonic over the pixels of a block, which stay in the processor's cache. They are in
single precision, which is as accurate as its J0.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy import sparse

from udccal.fitting.engine.gaussian import Prior
from udccal.fitting.engine.least_squares import Blocks, Step
from udccal.fitting.wire.data import BLOCK, FlatNoise, Pixels, Weighed, weighed
from udccal.fitting.wire.parameters import Kind, Parameters, shape_vector
from udccal.models.arrays import Arrayish
from udccal.models.bessel import bessel_j0_j1, sine_cosine
from udccal.models.geometry import rotation_matrix
from udccal.models.wire import LEAST_OPEN, Wire, legendre, waves
from udccal.numerics import in_two_threads

# Least residual variance in units of the noise's, so that quotients by it stay finite.
LEAST_VARIANCE = 1e-12
# Harmonics are filled up to multiples of these numbers, and degrees to the fit's own, so that functions are compiled
# once.
_ROOM, _FEW, _DEGREES = 1280, 8, 4


class Rays(NamedTuple):
    """The numbers per pixel through which modulation and baseline depend on the shape.

    Panel coordinates in periods and openings are (X, Y); ``ellipse`` (xx, xy, yy) gives kappa of a harmonic.
    """

    periods: Float[Arrayish, "2 *n"]
    openings: Float[Arrayish, "2 *n"]
    ellipse: Float[Arrayish, "3 *n"]


# Traced numbers of the pixels of a block.
_Each = Float[Array, " n"]
# Parameters, or a number of each pixel.
_Numbers = Float[np.ndarray, " n"]


def _rays(shape: Float[Array, "10"], mounted: Float[Arrayish, "3"], ideal: Float[Arrayish, "n 2"]) -> Rays:
    """Where rays of ideal image points meet the panel, by ``shape_vector`` and the geometry's rotation."""
    rotation = rotation_matrix(shape[:3]) @ rotation_matrix(mounted)
    ray = rotation @ jnp.insert(ideal, 2, 1.0, axis=1).T
    slope = ray[:2] / ray[2]
    # The pupil's axes, seen along each ray on the panel.
    x, y = rotation[:2, :2, None] - slope[:, None] * rotation[2, :2, None]
    ellipse = jnp.stack([(x * x).sum(axis=0), (x * y).sum(axis=0), (y * y).sum(axis=0)])
    openings = jnp.maximum(shape[8:6:-1, None] - shape[9] * jnp.abs(slope), LEAST_OPEN)
    return Rays(shape[4:6, None] + jnp.exp(shape[3]) * slope, openings, ellipse)


_compiled_rays = jax.jit(_rays)


def rays_at(wire: Wire, pixels: Pixels) -> Rays:
    """Where the pixels' rays meet the panel."""
    shape, mounted = shape_vector(wire), np.asarray(wire.geometry.rotation_rad)
    return pixels.by_block(lambda block: _compiled_rays(shape, mounted, block.ideal))


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


def values_at(wire: Wire, pixels: Pixels) -> tuple[_Numbers, _Numbers]:
    """1 + modulation and exp(B), whose product is the map."""
    filled = _filled(wire)
    whole, opened = pixels.by_block(lambda block: _values(filled, block))
    return whole, _base(wire, opened, pixels.scaled)


def wire_derivatives(wire: Wire, pixels: Pixels) -> tuple[_Numbers, _Numbers, Float[np.ndarray, "10 n"]]:
    """1 + modulation and exp(B), and derivatives by ``shape_vector`` relative to exp(B)."""
    filled = _filled(wire)
    whole, opened, by_shape = pixels.by_block(lambda block: _derivatives(filled, block))
    return whole, _base(wire, opened, pixels.scaled), by_shape


_Filled = tuple[Wire, Float[Arrayish, "10"], Int[Arrayish, ""]]


def _filled(wire: Wire) -> _Filled:
    """The wire with room for more harmonics, its ``shape_vector``, and the number of harmonics."""
    count, degrees = len(wire.harmonics), np.shape(wire.fields)[-1]
    more = (0, _ROOM - count % _ROOM), (0, 0)
    orders, frequency = (np.pad(part, more, constant_values=1.0) for part in (wire.harmonics, wire.frequency))
    fields = np.pad(wire.fields, (*more, (0, 0), (0, max(_DEGREES - degrees, 0))))
    filled = replace(wire, harmonics=orders, frequency=frequency, fields=fields)
    return jax.tree.map(jnp.asarray, filled), shape_vector(wire), np.asarray(count)


_Factors = tuple[_Each, tuple[_Each, _Each, _Each], tuple[_Each, _Each]]


class _Harmonic(NamedTuple):
    """One harmonic (n, m) at each pixel, in single precision."""

    order: Float[Array, "2"]
    frequency: Float[Array, "2"]
    fields: Float[Array, "2 2 degrees"]
    footprint: Float[Array, ""]
    rays: Rays

    def factors(self) -> _Factors:
        """Kappa; G, z G' and z (z G')' of a round pupil; cosine and sine of the phase."""
        (xx, xy, yy), (n, m), (x, y) = self.rays.ellipse, self.order, self.rays.periods
        kappa = jnp.sqrt(n * n * xx + 2 * n * m * xy + m * m * yy)
        z = jnp.pi * self.footprint * kappa
        j0, j1 = bessel_j0_j1(z)
        g = 2.0 * j1 / z
        slope = 2.0 * (j0 - g)
        sine, cosine = sine_cosine(2 * jnp.pi * (n * x + m * y))
        return kappa, (g, slope, -z * z * g - 2.0 * slope), (cosine, sine)

    def powers(self, kappa: _Each) -> Float[Array, "degrees n"]:
        """Legendre polynomials of kappa, scaled to its range."""
        return legendre((kappa - self.frequency[0]) / self.frequency[1], self.fields.shape[-1])

    def slits(self) -> tuple[Float[Array, "2 n"], Float[Array, "2 n"]]:
        """Coefficients 2 sin(pi m f) / (pi m f) along X and Y, 1 where m is 0, and their derivatives by f."""
        order, width = jnp.abs(self.order)[:, None], self.rays.openings
        half_turns = jnp.pi * jnp.maximum(order, 1.0) * width
        sine, cosine = sine_cosine(half_turns)
        sinc = sine / half_turns
        # cos(nX) cos(mY) is half the sum over (n, m) and (-n, m): the coefficients along X have that half.
        half = jnp.stack([jnp.where(jnp.all(order != 0), jnp.float32(0.5), jnp.float32(1.0)), jnp.float32(1.0)])[
            :, None
        ]
        slopes = jnp.where(order == 0, 0.0, 2.0 * (cosine - sinc) / width)
        return half * jnp.where(order == 0, 1.0, 2.0 * sinc), half * slopes

    def waved(self, series: Float[Array, "degrees n"], pupil: tuple[_Each, ...], wave: tuple[_Each, _Each]) -> _Each:
        """The wave by the field coefficients, whose degrees have these series and whose carriers are of the pupil."""
        return sum(
            sum(one * power for one, power in zip(by_degree, series, strict=True)) * carrier * part
            for by_carrier, part in zip(self.fields, wave, strict=True)
            for by_degree, carrier in zip(by_carrier, pupil, strict=True)
        )

    def value(self) -> _Each:
        """Its part of the modulation."""
        kappa, pupil, wave = self.factors()
        slit_x, slit_y = self.slits()[0]
        return self.waved(self.powers(kappa), pupil[:2], wave) * slit_x * slit_y

    def derivatives(self, factors: _Factors) -> tuple[_Each, ...]:
        """Its part of the modulation, and derivatives by periods, openings, ellipse and the pupil's logarithm."""
        (n, m), (kappa, pupil, wave) = self.order, factors
        ((slit_x, slit_y), (slope_x, slope_y)), powers = self.slits(), self.powers(kappa)
        both, (cosine, sine) = slit_x * slit_y, wave
        along = self.waved(powers, pupil[:2], wave)
        by_phase = 2 * jnp.pi * both * self.waved(powers, pupil[:2], (-sine, cosine))
        by_log_z = both * self.waved(powers, pupil[1:], wave)
        # The corrections to the pupil's transform are themselves series in kappa; P'_k = P'_(k-2) + (2 k - 1) P_(k-1).
        bent = [jnp.zeros_like(kappa), jnp.ones_like(kappa)]
        for k in range(2, len(powers)):
            bent.append(bent[k - 2] + (2 * k - 1) * powers[k - 1])
        by_series = both * self.waved(jnp.stack(bent[: len(powers)]), pupil[:2], wave) / self.frequency[1]
        by_kappa = by_log_z / kappa + by_series
        by_ellipse = (part * by_kappa / kappa for part in (n * n / 2, n * m, m * m / 2))
        by_openings = along * slope_x * slit_y, along * slope_y * slit_x
        return along * both, n * by_phase, m * by_phase, *by_openings, *by_ellipse, by_log_z


def _harmonics(wire: Wire, rays: Rays) -> Callable[[Int[Array, ""]], _Harmonic]:
    """Each harmonic by its number."""
    # Whole periods would cost digits in single precision.
    rays = rays._replace(periods=rays.periods - jnp.round(rays.periods))
    double = wire.harmonics, wire.frequency, wire.fields, wire.footprint_per_pitch, rays
    *each, footprint, rays = jax.tree.map(lambda one: jnp.asarray(one, jnp.float32), double)
    orders, frequency, fields = each
    return lambda h: _Harmonic(orders[h], frequency[h], fields[h], footprint, rays)


# The openings alone stand in place of exp(B), which needs no compiled code.
@jax.jit
def _values(filled: _Filled, block: Pixels) -> tuple[_Each, _Each]:
    wire, shape, count = filled
    rays = _rays(shape, wire.geometry.rotation_rad, block.ideal)
    harmonic, nothing = _harmonics(wire, rays), jnp.zeros(len(block.ideal), jnp.float32)
    modulated = jax.lax.fori_loop(0, count, lambda h, total: total + harmonic(h).value(), nothing)
    return 1.0 + modulated + _beside(wire, rays, block.scaled)[0], rays.openings.prod(axis=0)


@jax.jit
def _derivatives(filled: _Filled, block: Pixels) -> tuple[_Each, _Each, Float[Array, "10 n"]]:
    wire, shape, count = filled
    mounted = wire.geometry.rotation_rad
    rays = _rays(shape, mounted, block.ideal)
    harmonic, nothing = _harmonics(wire, rays), jnp.zeros(len(block.ideal), jnp.float32)

    def added(h: Int[Array, ""], carried: tuple[list[_Each], _Factors]) -> tuple[list[_Each], _Factors]:
        sums, factors = carried
        more = harmonic(h).derivatives(factors)
        # What the loop carries is computed once. Otherwise each sum would compute the factors anew.
        return [a + b for a, b in zip(sums, more, strict=True)], harmonic(h + 1).factors()

    # The loop begins with the last place, which has no amplitude.
    one = nothing + 1.0
    found, _ = jax.lax.fori_loop(-1, count, added, ([nothing] * 9, (one, (one, one, one), (one, one))))
    sums = jnp.stack(found)
    beside, by_periods = _beside(wire, rays, block.scaled)
    whole = 1.0 + sums[0] + beside
    by_ray = jnp.concatenate([sums[1:3] + by_periods, sums[3:5] + whole / rays.openings, sums[5:8]])
    moved = jnp.concatenate(jax.jacfwd(_rays)(shape, mounted, block.ideal))
    # The pupil acts on the harmonics alone.
    by_shape = jnp.einsum("kn,knp->pn", by_ray, moved).at[6].add(sums[8])
    return whole, rays.openings.prod(axis=0), by_shape


def _beside(wire: Wire, rays: Rays, scaled: Float[Arrayish, "n 2"]) -> tuple[_Each, Float[Array, "2 n"]]:
    """Modulation by the first harmonics' amplitudes that no pupil explains, and its derivatives by periods."""
    strongest, _, count_y, count_x = jnp.shape(wire.amplitudes)
    in_x, in_y = legendre(scaled[:, 0], count_x), legendre(scaled[:, 1], count_y)
    first = {name: getattr(wire, name)[:strongest] for name in ("harmonics", "frequency", "fields")}
    some = replace(wire, **first)
    cosine, sine = waves(some, rays.periods)
    cos, sin = jnp.einsum("hpyx,yn,xn->phn", wire.amplitudes, in_y, in_x)
    return (cos * cosine + sin * sine).sum(axis=0), 2 * jnp.pi * some.harmonics.T @ (sin * cosine - cos * sine)


def _base(wire: Wire, opened: _Numbers, scaled: Float[np.ndarray, "n 2"]) -> _Numbers:
    """exp(B): the shading times the openings."""
    in_x, in_y = np.polynomial.legendre.legvander(scaled.T, len(wire.baseline) - 1)
    return np.exp(((in_y @ wire.baseline) * in_x).sum(axis=1)) * opened


@jax.jit
def _linear(
    filled: _Filled, few: Int[Array, " few"], block: Pixels
) -> tuple[Float[Array, "few 2 n"], Float[Array, "few 2 n"], Float[Array, "few degrees n"]]:
    """Wave, carriers and powers of some harmonics: the factors of their linear coefficients."""
    wire, shape, _ = filled
    harmonic = _harmonics(wire, _rays(shape, wire.geometry.rotation_rad, block.ideal))

    def factors(h: Int[Array, ""]) -> tuple[Float[Array, "2 n"], Float[Array, "2 n"], Float[Array, "degrees n"]]:
        one = harmonic(h)
        kappa, pupil, wave = one.factors()
        return jnp.stack(wave), one.slits()[0].prod(axis=0) * jnp.stack(pupil[:2]), one.powers(kappa)

    return jax.lax.map(factors, few)


def expected_of(wire: Wire, gains: Float[np.ndarray, " sites"], pixels: Pixels) -> _Numbers:
    """The signal of a sample by the model, in CFA-balanced units."""
    whole, base = values_at(wire, pixels)
    return whole * base * gains[pixels.site]


def weighed_at(parameters: Parameters, x: _Numbers, pixels: Pixels, noise: FlatNoise) -> Weighed:
    """A sample weighted by the wire and the gains of these parameters."""
    return weighed(pixels, expected_of(parameters.wire(x), parameters.gains(x), pixels), noise)


def block_jacobian(
    parameters: Parameters, wire: Wire, block: Pixels
) -> tuple[_Numbers, _Numbers, Float[np.ndarray, "parameters n"]]:
    """1 + modulation, exp(B), and derivatives by the parameters relative to exp(B) and the gain, for one block."""
    filled = _filled(wire)
    whole, opened, by_shape = map(np.asarray, _derivatives(filled, block))
    in_x, in_y = np.polynomial.legendre.legvander(block.scaled.T, len(wire.baseline) - 1).transpose(0, 2, 1)
    # The baseline acts on everything: the change of exp(B) (1 + M), relative to exp(B), is (1 + M) dB.
    _, _, degree_y, degree_x = parameters.indices(Kind.SHADING)
    rows = [in_y[degree_y] * in_x[degree_x] * whole]
    of_site = np.append(np.eye(parameters.sites - 1), -np.ones((parameters.sites - 1, 1)), axis=1)[:, block.site]
    rows.append(of_site[parameters.indices(Kind.SITE)[0]] * whole)
    beside, free = parameters.indices(Kind.AMPLITUDE), parameters.indices(Kind.FIELD)
    if linear := 1 + int(max(beside[0].max(initial=-1), free[0].max(initial=-1))):
        firsts = np.arange(-(-linear // _FEW) * _FEW).reshape(-1, _FEW)
        parts = (_linear(filled, few, block) for few in firsts)
        wave, carrier, powers = (np.concatenate(part) for part in zip(*parts, strict=True))
        harmonic, phase, degree_y, degree_x = beside
        rows.append(wave[harmonic, phase] * in_y[degree_y] * in_x[degree_x])
        harmonic, phase, kind, degree = free
        rows.append(wave[harmonic, phase] * carrier[harmonic, kind] * powers[harmonic, degree])
    rows.append(by_shape[parameters.indices(Kind.SHAPE)[0]])
    return whole, _base(wire, opened, block.scaled), np.concatenate(rows)


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

    def equations_at(self, place: _Numbers) -> Blocks:
        """Cost and normal equations in units of the residual variance."""
        matrix, right, chi2 = self.sums(place)
        used, variance = self.pixels.used, self.variance(chi2)
        cost = max(used - len(place), 1) * float(np.log(variance))
        by_data = Blocks.dense(cost, used, matrix / variance, right / variance)
        return by_data.with_prior(self.prior, place)

    def variance(self, chi2: float) -> float:
        """Variance of the residuals in units of the noise's."""
        return chi2 / max(self.pixels.used - len(self.prior.mean), 1) + LEAST_VARIANCE

    def sums(self, place: _Numbers) -> tuple[Float[np.ndarray, "n n"], _Numbers, float]:
        """Information by the pixels' weights, the right side, and chi-squared."""

        def of(block: Pixels) -> tuple[Float[np.ndarray, "n n"], _Numbers, float]:
            errors, rows = self._weighted(place, block)
            return rows @ rows.T, rows @ errors, float(errors @ errors)

        matrices, right, chi2 = zip(*in_two_threads(of, self.pixels.blocks()), strict=True)
        return np.sum(matrices, axis=0), np.sum(right, axis=0), float(np.sum(chi2))

    def scores(
        self, place: _Numbers, groups: Sequence[tuple[Callable[[Pixels], Int[np.ndarray, " pixels"]], int]]
    ) -> list[Float[np.ndarray, "groups n"]]:
        """Parts of the right side by group of pixels; each way to group them numbers a pixel's group, of so many."""
        ends = np.cumsum([count for _, count in groups])

        def of(block: Pixels) -> Float[np.ndarray, "every n"]:
            errors, rows = self._weighted(place, block)
            own = [number(block) + end - count for (number, count), end in zip(groups, ends, strict=True)]
            at = np.concatenate(own), np.tile(np.arange(len(errors)), len(groups))
            sums = sparse.csr_array((np.ones(len(at[0])), at), (int(ends[-1]), len(errors)))
            return np.asarray(sums @ (errors * rows).T)

        return np.split(np.sum(in_two_threads(of, self.pixels.blocks()), axis=0), ends[:-1])

    def _weighted(
        self, place: _Numbers, block: Pixels
    ) -> tuple[Float[np.ndarray, " pixels"], Float[np.ndarray, "n pixels"]]:
        """Errors of a block's pixels and their Jacobian, over sigma."""
        wire, gains = self.parameters.wire(place), self.parameters.gains(place)
        whole, base, rows = block_jacobian(self.parameters, wire, block)
        level, root = base * gains[block.site], np.sqrt(block.weight)
        return (block.value - whole * level) * root, rows * (root * level)

    def moved(self, place: _Numbers, step: Step) -> _Numbers:
        """The place after a step."""
        return place + step.shared
