"""The kernel about a field position, on its lattice, and its Jacobian by the parameters of diffraction.

A transfer function is a sum of products of slits along columns, slits along rows, overlaps of the pupil and strengths
of the interference terms: it is linear in each, so that its derivatives are products, too, with one factor replaced by
its derivative. Only the factors are differentiated. It is linear in the spectra, so that one evaluation for every
wavelength node serves all colours and all their derivatives.
"""

from __future__ import annotations

from collections.abc import Callable
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
    average_of,
    average_transfer,
    lattice_frequencies,
    open_fractions,
    pupil_anchors,
    pupil_overlaps,
    sensor_transfer,
    slit_tables,
    through_sensor,
)
from udccal.models.interference import (
    HIGHEST_ORDER,
    footprint_place,
    interference_of,
    interference_transfer,
    node_overlaps,
    overlap_tables,
    strengths,
)
from udccal.models.lattice import Lattice, lattice_for, spline_coefficients

# Of the parameters: how many precede the spectra; the panel's pitch in mm, the pupil's diameter in mm, the logarithm of
# the blur in px, and where the footprint's centre lies on columns and rows, with its stand-off, in pitches.
HEAD: Final = 9
PITCH, PUPIL, BLUR, FOOTPRINT = 0, 4, 5, slice(6, 9)
_PER_PX: Final = 4
_MARGIN: Final = 1.25


def pack(model: Diffraction) -> Float[np.ndarray, " p"]:
    """Parameters as one vector: pitch, open fractions, thickness, pupil, log blur, footprint, log spectra.

    The kernel depends on the square of the blur: about none at all it would have no derivative, and two signs.
    """
    logs = np.log(np.maximum(np.asarray(model.spectrum), 1e-6))
    head = [model.pitch_mm, *np.asarray(model.openings), model.depth_mm, model.pupil_diameter_mm, np.log(model.blur_px)]
    head += [*np.asarray(model.offset_periods), model.standoff_per_pitch]
    return np.concatenate([np.array(head, dtype=float), (logs - logs.mean(axis=1, keepdims=True)).ravel()])


def unpack(theta: Float[Arrayish, " p"], wavelengths_nm: Float[Arrayish, " nodes"], interference: bool) -> Diffraction:
    """The model that a vector of parameters stands for."""
    theta = jnp.asarray(theta)
    return Diffraction(
        pitch_mm=theta[PITCH],
        openings=theta[1:3],
        depth_mm=theta[3],
        pupil_diameter_mm=theta[PUPIL],
        blur_px=jnp.exp(theta[BLUR]),
        offset_periods=theta[6:8],
        standoff_per_pitch=theta[8],
        visibility=float(interference),
        wavelengths_nm=jnp.asarray(wavelengths_nm),
        spectrum=jax.nn.softmax(theta[HEAD:].reshape(3, -1), axis=1),
    )


@final
class Evaluator(eqx.Module):
    """What stays the same from call to call.

    Attributes:
        wavelengths_nm: nodes of the spectra.
        lattice: for the transfer functions.
        interference: whether the footprint's place on the rows is known.
    """

    wavelengths_nm: Float[Arrayish, " nodes"]
    lattice: Lattice = eqx.field(static=True)
    interference: bool = eqx.field(static=True)

    def model(self, theta: Float[Arrayish, " p"]) -> Diffraction:
        """The model that a vector of parameters stands for."""
        return unpack(theta, self.wavelengths_nm, self.interference)


def fit_lattice(half: tuple[int, int]) -> Lattice:
    """Lattice that holds windows of ``half`` (rows, columns) to either side, sources off the middle included."""
    rows, columns = (2 * h + 9 for h in half)
    return lattice_for(rows * _MARGIN, columns * _MARGIN, _PER_PX, _PER_PX)


@eqx.filter_jit
def overlaps_of(
    evaluator: Evaluator, theta: Float[Arrayish, " p"], frame: LocalFrame
) -> Float[Array, "nodes terms rows half"]:
    """The slow part of interference, in single precision: it hardly changes in the course of a fit."""
    model = evaluator.model(theta)
    if not evaluator.interference:
        return jnp.zeros((0, 0, 0, 0), jnp.float32)
    return node_overlaps(model, frame, evaluator.lattice, overlap_tables(model, frame)).astype(jnp.float32)


@eqx.filter_jit
def kernel_coefficients(
    evaluator: Evaluator,
    theta: Float[Arrayish, " p"],
    frame: LocalFrame,
    disc_px: Float[Arrayish, ""],
    overlaps: Float[Arrayish, "n_nodes n_terms n_rows n_half"],
) -> Float[Array, "rows columns 3"]:
    """Spline coefficients of the three colours' kernel of a source whose image is ``disc_px`` wide."""
    model, lattice = evaluator.model(theta), evaluator.lattice
    spectra = jnp.asarray(model.spectrum)
    transfer = average_transfer(model, frame, lattice, spectra, disc_px)
    if evaluator.interference:
        transfer = transfer + interference_transfer(model, frame, lattice, spectra, overlaps, disc_px)
    return spline_coefficients(lattice, transfer)


def kernel_jacobian(
    evaluator: Evaluator,
    model: Diffraction,
    frame: LocalFrame,
    disc_px: Float[Arrayish, ""],
    overlaps: Float[Arrayish, "n_nodes n_terms n_rows n_half"],
) -> tuple[Float[Array, "rows columns nodes"], Float[Array, "rows columns factors 3"]]:
    """Spline coefficients of the kernel in the light of every wavelength node, and derivatives in all colours.

    Derivatives are by the factors of ``factor_jacobian``, the ``overlaps`` of interference held.
    """
    lattice, spectra = evaluator.lattice, jnp.asarray(model.spectrum)
    fx, fy = lattice_frequencies(frame, lattice)
    (columns, by_column), (rows, by_row) = (_slits(model, frame, axis, f) for axis, f in enumerate((fx, fy)))
    pupils, by_pupil = _with_derivative(
        lambda mm: pupil_overlaps(eqx.tree_at(lambda m: m.pupil_diameter_mm, model, mm), frame, lattice),
        model.pupil_diameter_mm,
    )
    sensor, by_blur = _with_derivative(
        lambda log: sensor_transfer(frame, fx, fy, jnp.exp(log), disc_px), jnp.log(model.blur_px)
    )
    place = footprint_place(model, frame)
    strength, share = strengths(model, place), pupil_anchors(model)[1]

    def light(factors: tuple[Array, ...], own: Float[Array, "c nodes"]) -> Float[Array, "c rows half"]:
        s, x, y, pupil = factors
        total = average_of(x[0], y[0], pupil, share, own)
        return total + interference_of(s, x, y, overlaps, own) if evaluator.interference else total

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


def factor_jacobian(model: Diffraction, frame: LocalFrame) -> Float[Array, "factors head"]:
    """Derivatives of the factors of ``kernel_jacobian`` by the parameters before the spectra, in their order.

    Factors: open part of columns and of rows along the ray, the pitch where it scales lags along columns and along
    rows, the pupil, the footprint's place (x, y), and the logarithm of the blur.
    """

    def factors(head: Float[Array, " head"]) -> Float[Array, " factors"]:
        panel = (head[0], head[1:3], head[3])
        own = eqx.tree_at(lambda m: (m.pitch_mm, m.openings, m.depth_mm), model, panel)
        own = eqx.tree_at(lambda m: (m.offset_periods, m.standoff_per_pitch), own, (head[6:8], head[8]))
        opened, place = open_fractions(own, frame), footprint_place(own, frame)
        return jnp.stack([*opened, head[PITCH], head[PITCH], head[PUPIL], *place, head[BLUR]])

    numbers = [model.pitch_mm, *jnp.asarray(model.openings), model.depth_mm, model.pupil_diameter_mm]
    numbers += [jnp.log(model.blur_px), *jnp.asarray(model.offset_periods), model.standoff_per_pitch]
    return jax.jacfwd(factors)(jnp.stack([jnp.asarray(number) for number in numbers]))


def _slits(
    model: Diffraction, frame: LocalFrame, axis: int, frequency: Float[Array, " n"]
) -> tuple[Float[Array, "orders n nodes"], Float[Array, "2 orders n nodes"]]:
    """Slits along an axis, and derivatives by the open part of a ray and by the pitch, each with the other held."""

    def table(opened: Float[Array, ""], pitch_mm: Float[Array, ""]) -> Float[Array, "orders n nodes"]:
        return slit_tables(eqx.tree_at(lambda m: m.pitch_mm, model, pitch_mm), opened, frequency, HIGHEST_ORDER)

    at = (open_fractions(model, frame)[axis], jnp.asarray(model.pitch_mm))
    value, derivatives = jax.vmap(lambda way: jax.jvp(table, at, (way[0], way[1])), out_axes=(None, 0))(jnp.eye(2))
    return value, derivatives


def _with_derivative(of: Callable[[Array], Array], at: Float[Arrayish, ""]) -> tuple[Array, Array]:
    number = jnp.asarray(at)
    value, derivative = jax.jvp(of, (number,), (jnp.ones_like(number),))
    return value, derivative
