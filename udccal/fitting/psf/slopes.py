"""The kernel on its lattice, light of each wavelength apart, and how it changes with the other global parameters.

A transfer function is a sum of products of slits along columns, slits along rows, overlaps of the pupil and strengths
of the interference terms: by each of these it is linear, so that its slopes are products, too, with one factor replaced
by its slope. Only the factors are differentiated.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from udccal.fitting.psf.blocks import Block
from udccal.models.arrays import Arrayish
from udccal.models.diffraction import (
    Diffraction,
    LocalFrame,
    average_of,
    lattice_frequencies,
    open_fractions,
    pupil_anchors,
    pupil_overlaps,
    sensor_transfer,
    slit_tables,
    through_sensor,
)
from udccal.models.interference import HIGHEST_ORDER, footprint_place, interference_of, strengths
from udccal.models.lattice import Lattice, spline_coefficients


def kernel_slopes(
    model: Diffraction,
    block: Block,
    lattice: Lattice,
    spectra: Float[Array, "3 nodes"],
    overlaps: Float[Arrayish, "n_nodes n_terms n_rows n_half"] | None,
) -> tuple[Float[Array, "rows columns nodes"], Float[Array, "rows columns factors 3"]]:
    """Spline coefficients of the kernel in the light of every wavelength node, and their slopes in all colours.

    Slopes are by what ``factors_by_parameter`` relates to parameters, with the ``overlaps`` of interference held. None:
    there is no interference.
    """
    frame, (fx, fy) = block.frame, lattice_frequencies(block.frame, lattice)
    (columns, by_column), (rows, by_row) = (_slits(model, frame, axis, f) for axis, f in enumerate((fx, fy)))
    pupils, by_pupil = jax.jvp(
        lambda mm: pupil_overlaps(_with_pupil(model, mm), frame, lattice), *_unit(model.pupil_mm)
    )
    sensor, by_blur = jax.jvp(
        lambda log: sensor_transfer(frame, fx, fy, jnp.exp(log), block.disc_px), *_unit(jnp.log(model.blur_px))
    )
    place = footprint_place(model, frame)
    strength, share = strengths(model, place), pupil_anchors(model)[1]

    def light(factors: tuple[Array, ...], own: Float[Array, "c nodes"]) -> Float[Array, "c rows half"]:
        s, x, y, pupil = factors
        total = average_of(x[0], y[0], pupil, share, own)
        return total if overlaps is None else total + interference_of(s, x, y, overlaps, own)

    by_place = jax.jacfwd(lambda at: strengths(model, at))(place)
    none = jnp.zeros_like(pupils)
    replaced = [
        (strength, by_column[0], rows, pupils),
        (strength, columns, by_row[0], pupils),
        (strength, by_column[1], rows, pupils),
        (strength, columns, by_row[1], pupils),
        (jnp.zeros_like(strength), columns, rows, by_pupil),
        (by_place[:, 0], columns, rows, none),
        (by_place[:, 1], columns, rows, none),
    ]
    stacked = tuple(jnp.stack(parts) for parts in zip(*replaced, strict=True))
    by_factor = jax.lax.map(lambda factors: light(factors, spectra), stacked)
    nodes = light((strength, columns, rows, pupils), jnp.eye(spectra.shape[1]))
    mixed = (spectra @ nodes.reshape(nodes.shape[0], -1)).reshape(3, *sensor.shape)
    channels = jnp.concatenate([nodes, by_factor.reshape(-1, *sensor.shape)])
    seen = jnp.concatenate([through_sensor(channels, sensor), through_sensor(mixed, by_blur)])
    flat = spline_coefficients(lattice, seen)
    count = spectra.shape[1]
    return flat[..., :count], flat[..., count:].reshape(*flat.shape[:2], -1, 3)


def factors_by_parameter(model: Diffraction, frame: LocalFrame) -> Float[Array, "factors head"]:
    """How the factors of ``kernel_slopes`` change with the parameters before the spectra, in their order.

    Factors: open part of columns and of rows along the ray, the pitch where it scales lags along columns and along
    rows, the pupil, the footprint's place (x, y), and the logarithm of the blur.
    """

    def factors(head: Float[Array, " head"]) -> Float[Array, " factors"]:
        panel = (head[0], head[1:3], head[3])
        own = eqx.tree_at(lambda m: (m.pitch_mm, m.open_fraction, m.thickness_mm), model, panel)
        own = eqx.tree_at(lambda m: (m.offset, m.standoff_per_pitch), own, (head[6:8], head[8]))
        opened, place = open_fractions(own, frame), footprint_place(own, frame)
        return jnp.stack([*opened, head[0], head[0], head[4], *place, head[5]])

    numbers = [model.pitch_mm, *jnp.asarray(model.open_fraction), model.thickness_mm, model.pupil_mm]
    numbers += [jnp.log(model.blur_px), *jnp.asarray(model.offset), model.standoff_per_pitch]
    return jax.jacfwd(factors)(jnp.stack([jnp.asarray(number) for number in numbers]))


def _slits(
    model: Diffraction, frame: LocalFrame, axis: int, frequency: Float[Array, " n"]
) -> tuple[Float[Array, "orders n nodes"], Float[Array, "2 orders n nodes"]]:
    """Slits along an axis, and their slopes by the open part of a ray and by the pitch, each with the other held."""

    def table(opened: Float[Array, ""], pitch_mm: Float[Array, ""]) -> Float[Array, "orders n nodes"]:
        return slit_tables(_with_pitch(model, pitch_mm), opened, frequency, HIGHEST_ORDER)

    at = (open_fractions(model, frame)[axis], jnp.asarray(model.pitch_mm))
    along = jnp.eye(2)
    value, slopes = jax.vmap(lambda way: jax.jvp(table, at, (way[0], way[1])), out_axes=(None, 0))(along)
    return value, slopes


def _unit(value: Float[Arrayish, ""]) -> tuple[tuple[Array], tuple[Array]]:
    """Where to differentiate by one number, and along what."""
    at = jnp.asarray(value)
    return (at,), (jnp.ones_like(at),)


def _with_pitch(model: Diffraction, pitch_mm: Float[Array, ""]) -> Diffraction:
    return eqx.tree_at(lambda m: m.pitch_mm, model, pitch_mm)


def _with_pupil(model: Diffraction, pupil_mm: Float[Array, ""]) -> Diffraction:
    return eqx.tree_at(lambda m: m.pupil_mm, model, pupil_mm)
