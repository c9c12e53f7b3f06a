"""The kernel about a field position, on its lattice, and its Jacobian by the parameters of diffraction.

A transfer function is a sum of products of slits along columns, slits along rows, overlaps of the pupil and strengths
of the interference terms. It is linear in each factor: a derivative is the same product with one factor replaced by its
derivative, and only factors are differentiated. It is also linear in the spectra: one evaluation per wavelength node
serves all colours and all their derivatives.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udccal.models.arrays import Arrayish
from udccal.models.diffraction import (
    Diffraction,
    LocalFrame,
    average_transfer,
    blur_variance,
    lattice_frequencies,
    opening_overlaps,
    pupil_anchors,
    pupil_overlaps,
    sensor_transfer,
    slits_along,
    slits_of,
)
from udccal.models.interference import (
    COLUMN_OF,
    HIGHEST_ORDER,
    ROW_OF,
    footprint_place,
    interference_transfer,
    node_overlaps,
    overlap_tables,
    strengths,
)
from udccal.models.lattice import Lattice, lattice_for, sample, spline_coefficients
from udccal.models.slits import Slits

WAVELENGTHS_NM: Final = np.linspace(400.0, 700.0, 13)
# Nodes of a fit's lattice to a pixel. The light of an LED whose image is a pixel wide errs by up to 0.3 %, and by up to
# 0.9 % with 4. Derivatives need as many: with 4, small blurs ended 9 sigma beside the minimum.
PER_PX: Final = 6
# HEAD parameters precede the spectra. The others are indices among these: the panel's pitch in mm, the pupil's diameter
# in mm, the logarithm of the blur in px, bars of (columns, rows), logarithms of the corners' radius and of slants of
# (columns, rows), and the footprint's place on columns and rows with its stand-off, in pitches.
HEAD: Final = 21
PITCH, PUPIL, BLUR, GROWTH, BLUR_RED, BLUR_BLUE, DEPTH_RATIO = 0, 4, 5, slice(6, 8), 8, 9, 10
OPENINGS, BAR_WIDTH, BAR_PLACE, CORNER = slice(1, 3), slice(11, 13), slice(13, 15), 15
SLANT, FOOTPRINT = slice(16, 18), slice(18, 21)
# What pairs of (columns, rows) are of.
AXES: Final = ("columns", "rows")
# Parameters of diffraction.
Theta = Float[np.ndarray, " p"]
Overlaps = Float[Arrayish, "nodes terms rows half"]
# Tables of slits of columns and of rows.
Tables = tuple[Array, Array]


@final
@dataclass(frozen=True)
class Kernel:
    """A picture about a position for each colour, or each of some channels: its spline coefficients."""

    lattice: Lattice
    coefficients: Float[np.ndarray, "y x channels"]

    def at(self, points_px: Float[np.ndarray, "*points 2"]) -> Float[np.ndarray, "*points channels"]:
        """Return the density per square px at places (x, y) from the position."""
        values = sample(self.lattice, self.coefficients, points_px.reshape(-1, 2))
        return np.asarray(values.reshape(*points_px.shape[:-1], -1))


@final
class Evaluator(eqx.Module):
    """The constants of a fit that every call uses.

    Attributes:
        wavelengths_nm: nodes of the spectra.
        lattice: of kernels.
        interference: whether the footprint's place on rows is known.
        shaped: whether openings may have bars, round corners and slants. Without, the latter two are left out and bars
            have no derivatives, which saves time.
    """

    wavelengths_nm: Float[Arrayish, " nodes"]
    lattice: Lattice = eqx.field(static=True)
    interference: bool = eqx.field(static=True)
    shaped: bool = eqx.field(static=True, default=False)

    def model(self, theta: Float[Arrayish, " p"]) -> Diffraction:
        """Return the model of a vector of parameters; see ``start.pack``."""
        theta = jnp.asarray(theta)
        return Diffraction(
            pitch_mm=theta[PITCH],
            openings=theta[OPENINGS],
            depth_mm=theta[3],
            depth_ratio=theta[DEPTH_RATIO],
            bar_width=theta[BAR_WIDTH],
            bar_place=theta[BAR_PLACE],
            corner_radius=self.shaped * jnp.exp(theta[CORNER]),
            slant=self.shaped * jnp.exp(theta[SLANT]),
            pupil_diameter_mm=theta[PUPIL],
            blur_px=jnp.exp(theta[BLUR]),
            blur_growth=theta[GROWTH],
            blur_colour=jnp.stack([theta[BLUR_RED], jnp.zeros_like(theta[BLUR]), theta[BLUR_BLUE]]),
            offset_periods=theta[FOOTPRINT][:2],
            standoff_per_pitch=theta[FOOTPRINT][2],
            visibility=float(self.interference),
            wavelengths_nm=jnp.asarray(self.wavelengths_nm),
            spectrum=jax.nn.softmax(theta[HEAD:].reshape(3, -1), axis=1),
        )

    @eqx.filter_jit
    def overlaps(self, theta: Float[Arrayish, " p"], frame: LocalFrame) -> Float[Array, "nodes terms rows half"]:
        """Return the slow part of interference, in single precision: it hardly changes during a fit."""
        model, lattice = self.model(theta), self.lattice
        if not self.interference:
            return jnp.zeros((len(self.wavelengths_nm), 0, lattice.rows, lattice.columns // 2 + 1), jnp.float32)
        return node_overlaps(model, frame, lattice, overlap_tables(model, frame)).astype(jnp.float32)

    @eqx.filter_jit
    def kernel(
        self, theta: Float[Arrayish, " p"], frame: LocalFrame, disc_px: Float[Arrayish, ""], overlaps: Overlaps
    ) -> Float[Array, "lattice_rows lattice_columns 3"]:
        """Return spline coefficients of the three colours' kernels, for a source whose image is ``disc_px`` wide."""
        model, lattice = self.model(theta), self.lattice
        transfer = average_transfer(model, frame, lattice, jnp.asarray(model.spectrum), disc_px, shaped=self.shaped)
        if self.interference:
            strength = strengths(model, footprint_place(model, frame))
            transfer += interference_transfer(model, frame, lattice, model.spectrum, overlaps, strength, disc_px)
        return spline_coefficients(lattice, transfer)

    @eqx.filter_jit
    def moved(
        self,
        theta: Float[Arrayish, " p"],
        frame: LocalFrame,
        disc_px: Float[Arrayish, ""],
        overlaps: Overlaps,
        change: Float[Arrayish, "2"],
    ) -> Float[Array, "lattice_rows lattice_columns 3"]:
        """Return by how much ``kernel`` is more where the footprint's place (x, y) is more by ``change`` pitches."""
        model, lattice = self.model(theta), self.lattice
        place = footprint_place(model, frame)
        more = strengths(model, place + jnp.asarray(change)) - strengths(model, place)
        transfer = interference_transfer(model, frame, lattice, model.spectrum, overlaps, more, disc_px)
        return spline_coefficients(lattice, transfer)

    @eqx.filter_jit
    def jacobian(
        self, theta: Float[Arrayish, " p"], frame: LocalFrame, disc_px: Float[Arrayish, ""], overlaps: Overlaps
    ) -> tuple[Float[Array, "y x channels"], Float[Array, "factors 3 head"]]:
        """Return spline coefficients of the kernel at every wavelength node, and its derivatives by factor and colour.

        Factors: open part of columns and of rows along the ray, the pitch where it scales lags, the pupil, the
        footprint's place (x, y), bars, corners and slants if there may be any, and the blur's covariance, with the
        ``overlaps`` of interference held. The second result has their derivatives by the parameters before the spectra.
        """
        model, lattice = self.model(theta), self.lattice
        spectra, variance = jnp.asarray(model.spectrum), blur_variance(model, frame)
        fx, fy = lattice_frequencies(frame, lattice)

        def overlapping(pupil_mm: Float[Array, ""]) -> Float[Array, "anchors rows half"]:
            return pupil_overlaps(eqx.tree_at(lambda m: m.pupil_diameter_mm, model, pupil_mm), frame, lattice)

        pupils, by_pupil = jax.jvp(overlapping, (model.pupil_diameter_mm,), (jnp.ones_like(model.pupil_diameter_mm),))
        sensor, along = jax.linearize(lambda at: sensor_transfer(frame, fx, fy, at, disc_px), variance)
        # Each colour depends on its own variance.
        by_blur = jax.vmap(lambda way: along(jnp.tile(way, (3, 1))))(jnp.eye(3, dtype=variance.dtype))
        place, slits, terms = footprint_place(model, frame), slits_along(model, frame), np.shape(overlaps)[1]
        column_of, row_of = COLUMN_OF[:terms], ROW_OF[:terms]
        strength = strengths(model, place)[:terms, None]
        by_place = jax.jacfwd(lambda at: strengths(model, at)[:terms])(place)

        def at_node(node: tuple[Tables, Tables, Array, Array]) -> Float[Array, "variants rows half"]:
            (columns, rows), of_orders, own, part = node
            average, narrower = (jnp.tensordot(part, anchors, 1) for anchors in (pupils, by_pupil))
            x, y = of_orders[0][:, column_of, None, :] * own, strength * of_orders[1][:, row_of]

            def light(across: int, down: int) -> Float[Array, "rows half"]:
                alone = (rows[down].T @ columns[across]) * average
                # Corners and slants are in the average alone.
                return alone + between(x[across], y[down]) if max(across, down) < len(x) else alone

            def between(across: Array, down: Array) -> Float[Array, "rows half"]:
                return jnp.sum(down[..., None] * across, axis=0)

            moved = [between(x[0], by[:, None] * of_orders[1][0, row_of]) for by in by_place.T]
            shape = [light(*((way, 0) if axis == 0 else (0, way))) for axis in (0, 1) for way in range(3, len(columns))]
            widths = [light(0, 0), light(1, 0), light(0, 1), light(2, 0) + light(0, 2)]
            return jnp.stack([*widths, (rows[0].T @ columns[0]) * narrower, *moved, *shape])

        parts = self._parts(model, slits, fx, fy)
        orders = self._tables(lambda m, s: slits_of(m, s, fx, fy, HIGHEST_ORDER), model, slits, 4 if self.shaped else 2)
        every = jax.lax.map(at_node, (parts, orders, jnp.asarray(overlaps), pupil_anchors(model)[1].T))
        # As one product of matrices: an einsum over the nodes takes five times as long.
        mixed = (spectra @ every.reshape(len(every), -1)).reshape(len(spectra), *every.shape[1:])
        by_factor = jax.lax.map(lambda one: one * sensor, jnp.swapaxes(mixed[:, 1:], 0, 1))
        moved = jax.lax.map(lambda one: one * mixed[:, 0], by_blur)
        # Of derivatives by spectra, the blur of green will do: those of other colours would be twice as many channels.
        seen = jnp.concatenate([jax.lax.map(lambda one: one * sensor[1], every[:, 0]), *by_factor, *moved])

        def factors(head: Float[Array, " head"]) -> Float[Array, "factors 3"]:
            model = self.model(jnp.concatenate([head, jnp.asarray(theta)[HEAD:]]))
            slits = slits_along(model, frame)
            shape = jnp.stack([slits.bar_width, slits.bar_place, slits.corner_radius, slits.slant], axis=1).ravel()
            shape = shape[: shape.size * self.shaped]
            others = head[jnp.array([PITCH, PUPIL])], footprint_place(model, frame)
            common = jnp.concatenate([slits.opened, *others, shape])
            return jnp.concatenate([jnp.tile(common[:, None], (1, 3)), blur_variance(model, frame).T])

        return spline_coefficients(lattice, seen), jax.jacfwd(factors)(jnp.asarray(theta)[:HEAD])

    def _tables(
        self, of_slits: Callable[[Diffraction, Slits], Tables], model: Diffraction, slits: Slits, ways: int
    ) -> Tables:
        """Return tables of slits by node: their values, and ``ways`` derivatives.

        These are by open part, pitch, bar's width, bar's place, corner's radius and slant, in this order. Columns
        depend on their own openings, bars and corners alone, as do rows.
        """

        def at(slits: Slits, pitch_mm: Float[Array, ""]) -> Tables:
            return of_slits(eqx.tree_at(lambda m: m.pitch_mm, model, pitch_mm), slits)

        def changed(way: Float[Array, "6"]) -> tuple[Tables, Tables]:
            moved = Slits(*(jnp.full(2, way[part]) for part in (0, 2, 3, 4, 5)))
            return jax.jvp(at, (slits, jnp.asarray(model.pitch_mm)), (moved, way[1]))

        value, derivatives = jax.vmap(changed, out_axes=(None, 0))(jnp.eye(6)[:ways])
        return jax.tree.map(lambda own, by: jnp.moveaxis(jnp.concatenate([own[None], by]), -1, 0), value, derivatives)

    def _parts(self, model: Diffraction, slits: Slits, fx: Float[Array, " half"], fy: Float[Array, " rows"]) -> Tables:
        """Return parts of the average and their derivatives, as fractions of what is open, which changes with them."""
        ways = 6 if self.shaped else 2
        found = self._tables(lambda m, s: opening_overlaps(m, s, fx, fy, self.shaped), model, slits, ways)
        opened, by = jax.value_and_grad(lambda at: at.open_part(self.shaped))(slits)
        others = by.bar_width, by.bar_place, by.corner_radius, by.slant
        grown = jnp.stack([jnp.zeros(2), by.opened, jnp.zeros(2), *others]) / opened
        columns, rows = (part - grown[: ways + 1, axis, None, None] * part[:, :1] for axis, part in enumerate(found))
        return columns, rows / opened


def fit_lattice(half: tuple[int, int]) -> Lattice:
    """Return a fit's lattice, a quarter wider than the window, for sources off the middle."""
    rows, columns = (1.25 * (2 * h + 9) for h in half)
    return lattice_for(rows, columns, PER_PX, PER_PX)
