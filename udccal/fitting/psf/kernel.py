"""The kernel about a field position, on its lattice, and its Jacobian by the parameters of diffraction.

A transfer function is a sum of products of slits along columns, slits along rows, overlaps of the pupil and strengths
of the interference terms. It is linear in each factor: a derivative is the same product with one factor replaced by its
derivative, and only factors are differentiated. It is also linear in the spectra: one evaluation per wavelength node
serves all colours and all their derivatives.
"""

from __future__ import annotations

from typing import Final, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udccal.fitting.engine.gaussian import Prior
from udccal.fitting.psf.data import PsfRules
from udccal.models.arrays import Arrayish
from udccal.models.diffraction import (
    Diffraction,
    LocalFrame,
    average_of,
    blur_variance,
    lattice_frequencies,
    open_fractions,
    pupil_anchors,
    pupil_overlaps,
    sensor_transfer,
    slits_of,
    through_sensor,
)
from udccal.models.geometry import Geometry
from udccal.models.interference import (
    HIGHEST_ORDER,
    TERMS,
    footprint_place,
    interference_of,
    node_overlaps,
    overlap_tables,
    strengths,
)
from udccal.models.lattice import Lattice, lattice_for, spline_coefficients
from udccal.models.wire import Wire
from udccal.rig import RigDescription

WAVELENGTHS_NM: Final = np.linspace(400.0, 700.0, 13)

# HEAD parameters precede the spectra. The others are indices among these: the panel's pitch in mm, the pupil's diameter
# in mm, the logarithm of the blur in px, and the footprint's place on columns and rows with its stand-off, in pitches.
HEAD: Final = 13
PITCH, PUPIL, BLUR, GROWTH, FOOTPRINT = 0, 4, 5, slice(6, 8), slice(10, 13)
BLUR_RED, BLUR_BLUE = 8, 9


def pack(model: Diffraction) -> Float[np.ndarray, " p"]:
    """Return the parameters as one vector: see ``Evaluator.model``; blur and spectra as logarithms.

    The kernel depends on the square of the blur. The logarithm avoids its two signs and its zero derivative at 0.
    """
    logs = np.log(np.maximum(np.asarray(model.spectrum), 1e-6))
    red, green, blue = np.asarray(model.blur_colour)
    head = [model.pitch_mm, *np.asarray(model.openings), model.depth_mm, model.pupil_diameter_mm]
    head += [
        np.log(model.blur_px) + green,
        *np.asarray(model.blur_growth),
        red - green,
        blue - green,
        *np.asarray(model.offset_periods),
        model.standoff_per_pitch,
    ]
    return np.concatenate([np.array(head, dtype=float), (logs - logs.mean(axis=1, keepdims=True)).ravel()])


@final
class Evaluator(eqx.Module):
    """The constants of a fit that every call uses; ``interference`` where the footprint's place on rows is known."""

    wavelengths_nm: Float[Arrayish, " nodes"]
    lattice: Lattice = eqx.field(static=True)
    interference: bool = eqx.field(static=True)

    def model(self, theta: Float[Arrayish, " p"]) -> Diffraction:
        """Return the model of a vector of parameters; see ``pack``."""
        theta = jnp.asarray(theta)
        return Diffraction(
            pitch_mm=theta[PITCH],
            openings=theta[1:3],
            depth_mm=theta[3],
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


def fit_lattice(half: tuple[int, int]) -> Lattice:
    """Return a fit's lattice: four nodes to a pixel, a quarter wider than the window, for sources off the middle."""
    rows, columns = (2 * h + 9 for h in half)
    return lattice_for(rows * 1.25, columns * 1.25, 4, 4)


@eqx.filter_jit
def overlaps_of(
    evaluator: Evaluator, theta: Float[Arrayish, " p"], frame: LocalFrame
) -> Float[Array, "nodes terms rows half"]:
    """Return the slow part of interference, in single precision: it hardly changes during a fit."""
    model, lattice = evaluator.model(theta), evaluator.lattice
    if not evaluator.interference:
        return jnp.zeros((len(evaluator.wavelengths_nm), 0, lattice.rows, lattice.columns // 2 + 1), jnp.float32)
    return node_overlaps(model, frame, lattice, overlap_tables(model, frame)).astype(jnp.float32)


@eqx.filter_jit
def kernel_coefficients(
    evaluator: Evaluator,
    theta: Float[Arrayish, " p"],
    frame: LocalFrame,
    disc_px: Float[Arrayish, ""],
    overlaps: Float[Arrayish, "nodes terms rows half"],
) -> Float[Array, "lattice_rows lattice_columns 3"]:
    """Return spline coefficients of the three colours' kernels, for a source whose image is ``disc_px`` wide."""
    model, lattice = evaluator.model(theta), evaluator.lattice
    spectra, (fx, fy) = jnp.asarray(model.spectrum), lattice_frequencies(frame, lattice)
    columns, rows = slits_of(
        model, open_fractions(model, frame), fx, fy, HIGHEST_ORDER if evaluator.interference else 0
    )
    pupils, (_, parts) = pupil_overlaps(model, frame, lattice), pupil_anchors(model)
    transfer = average_of(columns[0], rows[0], pupils, parts, spectra)
    if evaluator.interference:
        strength = strengths(model, footprint_place(model, frame))
        transfer = transfer + interference_of(strength, columns, rows, overlaps, spectra)
    sensor = sensor_transfer(frame, fx, fy, blur_variance(model, frame), disc_px)
    return spline_coefficients(lattice, through_sensor(transfer, sensor))


@eqx.filter_jit
def kernel_jacobian(
    evaluator: Evaluator,
    theta: Float[Arrayish, " p"],
    frame: LocalFrame,
    disc_px: Float[Arrayish, ""],
    overlaps: Float[Arrayish, "nodes terms rows half"],
) -> tuple[Float[Array, "y x channels"], Float[Array, "factors 3 head"]]:
    """Return spline coefficients of the kernel at every wavelength node, and of its derivatives by factors and colours.

    Factors: open part of columns and of rows along the ray, the pitch where it scales lags, the pupil, the footprint's
    place (x, y), and the blur's covariance, with the ``overlaps`` of interference held. The second result has their
    derivatives by the parameters before the spectra. The average over the footprint's place is one more term of
    interference, (0, 0), of strength 1.
    """
    model, lattice = evaluator.model(theta), evaluator.lattice
    spectra = jnp.asarray(model.spectrum)
    fx, fy = lattice_frequencies(frame, lattice)
    slits = _slits(model, frame, fx, fy)
    pupil_mm = jnp.asarray(model.pupil_diameter_mm)
    pupils, by_pupil = jax.jvp(
        lambda mm: pupil_overlaps(eqx.tree_at(lambda m: m.pupil_diameter_mm, model, mm), frame, lattice),
        (pupil_mm,),
        (jnp.ones_like(pupil_mm),),
    )
    variance = blur_variance(model, frame)
    sensor, along = jax.linearize(lambda at: sensor_transfer(frame, fx, fy, at, disc_px), variance)
    # Each colour depends on its own variance.
    by_blur = jax.vmap(lambda way: along(jnp.tile(way, (3, 1))))(jnp.eye(3, dtype=variance.dtype))
    place, terms = footprint_place(model, frame), np.array([(0.0, 0.0), *TERMS][: 1 + np.shape(overlaps)[1]])
    column_of, row_of = np.abs(terms).astype(np.int32).T
    strength = jnp.append(1.0, strengths(model, place))[: len(terms), None]
    by_place = jnp.pad(jax.jacfwd(lambda at: strengths(model, at))(place), ((1, 0), (0, 0)))[: len(terms)]

    def at_node(node: tuple[Array, Array, Array, Array]) -> Float[Array, "variants rows half"]:
        columns, rows, own, part = node
        average, narrower = (jnp.tensordot(part, anchors, 1) for anchors in (pupils, by_pupil))
        overlap = jnp.concatenate([average[None], own])
        x, by_open_x, by_pitch_x = columns[:, column_of, None, :] * overlap
        y, by_open_y, by_pitch_y = strength * rows[:, row_of]

        def light(
            down: Float[Array, "terms rows"], across: Float[Array, "terms rows half"]
        ) -> Float[Array, "rows half"]:
            return jnp.sum(down[..., None] * across, axis=0)

        by_pitch, pupil = light(y, by_pitch_x) + light(by_pitch_y, x), rows[0, 0][:, None] * columns[0, 0] * narrower
        moved = [light(by[:, None] * rows[0, row_of], x) for by in by_place.T]
        return jnp.stack([light(y, x), light(y, by_open_x), light(by_open_y, x), by_pitch, pupil, *moved])

    every = jax.lax.map(at_node, (*slits, jnp.asarray(overlaps), pupil_anchors(model)[1].T))
    # As one product of matrices: an einsum over the nodes takes five times as long.
    mixed = (spectra @ every.reshape(len(every), -1)).reshape(len(spectra), *every.shape[1:])
    by_factor = jax.lax.map(lambda one: one * sensor, jnp.swapaxes(mixed[:, 1:], 0, 1))
    moved = jax.lax.map(lambda one: one * mixed[:, 0], by_blur)
    # Of derivatives by spectra, the blur of green will do: those of other colours would be twice as many channels.
    seen = jnp.concatenate([jax.lax.map(lambda one: one * sensor[1], every[:, 0]), *by_factor, *moved])

    def factors(head: Float[Array, " head"]) -> Float[Array, "factors 3"]:
        model = evaluator.model(jnp.concatenate([head, jnp.asarray(theta)[HEAD:]]))
        opened, place = open_fractions(model, frame), footprint_place(model, frame)
        common = jnp.stack([*opened, head[PITCH], head[PUPIL], *place])
        return jnp.concatenate([jnp.tile(common[:, None], (1, 3)), blur_variance(model, frame).T])

    return spline_coefficients(lattice, seen), jax.jacfwd(factors)(jnp.asarray(theta)[:HEAD])


def _slits(
    model: Diffraction, frame: LocalFrame, fx: Float[Array, " half"], fy: Float[Array, " rows"]
) -> tuple[Float[Array, "nodes 3 orders half"], Float[Array, "nodes 3 orders rows"]]:
    """Return slits of both axes, and derivatives by a ray's open part and by the pitch, with the other held."""

    def tables(opened: Float[Array, "2"], pitch_mm: Float[Array, ""]) -> tuple[Array, Array]:
        return slits_of(eqx.tree_at(lambda m: m.pitch_mm, model, pitch_mm), opened, fx, fy, HIGHEST_ORDER)

    at = (open_fractions(model, frame), jnp.asarray(model.pitch_mm))
    ways = (jnp.array([[1.0, 1.0], [0.0, 0.0]]), jnp.array([0.0, 1.0]))
    value, derivatives = jax.vmap(lambda *way: jax.jvp(tables, at, way), out_axes=(None, 0))(*ways)
    columns, rows = (
        jnp.moveaxis(jnp.concatenate([own[None], by]), -1, 0) for own, by in zip(value, derivatives, strict=True)
    )
    return columns, rows


def as_numpy(model: Diffraction) -> Diffraction:
    """Return the model with numpy leaves."""
    return Diffraction(*(np.asarray(getattr(model, name), np.float64) for name in Diffraction.__dataclass_fields__))


def start_model(rig: RigDescription, geometry: Geometry, wire: Wire, rules: PsfRules | None = None) -> Diffraction:
    """Return the start of diffraction: the wire's panel and pupil, or the rig's if no wire was seen.

    Args:
        rig: the panel and the lens as described; lengths in mm.
        geometry: has the pupil's position, in mm.
        wire: its numbers are in pitches of the panel.
        rules: the blur, and which pitches are well known.
    """
    panel, pitch, rules = rig.panel, rig.panel.pitch_mm.value, rules or PsfRules()
    nodes = wavelengths_nm(rig, rules)
    # Those of common colour filters.
    responses = np.exp(-0.5 * ((nodes - np.array([[600.0], [535.0], [460.0]])) / 45.0) ** 2) + 1e-3
    pupil = np.asarray(geometry.pupil_mm, dtype=np.float64)
    if seen := wire_shows(wire):
        opened, offset = (wire.column_open, wire.row_open), wire.offset_periods
        lengths = (wire.depth_per_pitch, wire.footprint_per_pitch, wire.standoff_per_pitch)
    else:
        opened, offset = (panel.column_open.value, panel.row_open.value), pupil[:2] / pitch
        lengths = (panel.depth_mm.value / pitch, rig.pupil_diameter_mm / pitch, -pupil[2] / pitch)
    return Diffraction(
        pitch_mm=np.float64(pitch),
        openings=np.array([float(part) for part in opened]),
        depth_mm=np.float64(float(lengths[0]) * pitch),
        pupil_diameter_mm=np.float64(float(lengths[1]) * pitch),
        blur_px=np.float64(rules.blur_px),
        blur_growth=np.zeros(2),
        blur_colour=np.zeros(3),
        offset_periods=np.asarray(offset, dtype=np.float64),
        standoff_per_pitch=np.float64(float(lengths[2])),
        visibility=np.float64(seen),
        wavelengths_nm=nodes,
        spectrum=responses / responses.sum(axis=1, keepdims=True),
    )


def wire_shows(wire: Wire) -> bool:
    """Return whether the wire fit saw the rows: only then the place of the pupil's footprint on them is known."""
    return np.shape(wire.harmonics)[0] > 0


def wavelengths_nm(rig: RigDescription, rules: PsfRules) -> Float[np.ndarray, " nodes"]:
    """Return the spectra's nodes in nm: those of daylight, wider by the pitch's tolerance where that is large."""
    relative = min(pitch_tolerance(rig), rules.pitch_least_known)
    if relative <= rules.pitch_well_known:
        return WAVELENGTHS_NM
    first, last = WAVELENGTHS_NM[0] * (1 - relative), WAVELENGTHS_NM[-1] * (1 + relative)
    return np.linspace(first, last, round((last - first) / (WAVELENGTHS_NM[1] - WAVELENGTHS_NM[0])) + 1)


def pitch_tolerance(rig: RigDescription) -> float:
    """Return the relative tolerance of the pitch, in which the psf measures all lengths."""
    return rig.panel.pitch_mm.tolerance / rig.panel.pitch_mm.value


def start_prior(rig: RigDescription, start: Diffraction, rules: PsfRules | None = None) -> Prior:
    """Return the prior: the rig's tolerances, tighter for what the wire has measured, and smooth spectra.

    Diffraction depends on wavelength / pitch only. The pitch is therefore held at the rig's value, and the spectra are
    free to move: an error of the pitch then appears as an error of the wavelengths.

    Args:
        rig: its tolerances (mm, or fractions) are taken for standard deviations.
        start: the mean; its ``visibility`` says whether the wire has measured the panel's numbers.
        rules: sigmas of the other parameters.
    """
    panel, theta, rules = rig.panel, pack(start), rules or PsfRules()
    tighter = rules.wire_tolerance if start.visibility else 1.0
    sigma = [
        rules.pitch_tolerance * min(panel.pitch_mm.tolerance, rules.pitch_well_known * panel.pitch_mm.value),
        tighter * panel.column_open.tolerance,
        tighter * panel.row_open.tolerance,
        tighter * panel.depth_mm.tolerance,
        tighter * 2.0 * rig.pupil_diameter_mm * rig.lens.f_number.tolerance / rig.lens.f_number.value,
        rules.blur_log_sigma,
        *(2 * (rules.blur_growth,)),
        *(2 * (rules.blur_colour,)),
        *(3 * (rules.footprint_periods,)),
    ]
    roots = [np.eye(HEAD, theta.size) / np.maximum(np.array(sigma), 1e-6)[:, None]]
    for pick in np.eye(theta.size)[HEAD:].reshape(3, -1, theta.size):
        roots += [np.diff(pick, 2, axis=0) / rules.spectrum_bend, pick / rules.spectrum_sigma]
    return Prior(theta.copy(), np.concatenate(roots))
