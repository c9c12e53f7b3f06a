"""What the diffraction fit works with: samples by field position, and its parameters as one vector."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from udccal.fitting.psf.shots import Shots
from udccal.models.arrays import Arrayish
from udccal.models.diffraction import Diffraction, LocalFrame, local_frame
from udccal.models.geometry import Geometry
from udccal.models.lattice import Lattice, lattice_for
from udccal.models.psf import lattice_points

LOCAL = 6  # a shot's own unknowns: x, y, red, green, blue, background
HEAD = 9  # global parameters before the spectra
PITCH = 0  # of these: the pitch of the panel in mm
PUPIL = 4  # of these: its diameter in mm
BLUR = 5  # of these: the logarithm of the blur in px
FOOTPRINT = slice(6, 9)  # of these: where its centre lies on columns and rows, and its stand-off, in pitches
_PER_PX = 4
_MARGIN = 1.25


# Of a block, what it has by shot and sample.
_BY_SAMPLE = (
    "points",
    "density",
    "colour",
    "rate",
    "known",
    "noise_per_rate",
    "weight",
    "correction",
    "overlap_slope",
    "pitch_slope",
)


class Block(eqx.Module):
    """The chosen samples of all shots of one field position, padded to one size with samples of weight 0.

    Attributes:
        points, density: samples on the lattice about the mean place; see ``models.psf.lattice_points``.
        slope: lattice units per pixel, to move a source.
        begun_px: (x, y) of the shots from the mean place, as first assumed.
        colour: which of three colours a sample has (one-hot).
        known: inverse variance of a sample as it was measured, 0 where there is none.
        noise_per_rate: by how much that variance grows with the light, in (e-/s)^2 per e-/s.
        weight: inverse variance that the fit goes by; see ``psf.weights``.
        correction: per unit of light of a sample's colour, what a shot has more because the pupil's footprint lies
            elsewhere on the rows than at the mean place.
        overlap_slope, pitch_slope: by how much interference changes with the pupil, and with the pitch, because
            overlaps do, per mm and unit of light; overlaps_pupil_mm, overlaps_pitch_mm: those that overlaps are of.
        index: which shots these are.
    """

    frame: LocalFrame
    points: Float[Arrayish, "shots n 2"]
    density: Float[Arrayish, "shots n"]
    slope: Float[Arrayish, "2 2"]
    begun_px: Float[Arrayish, "shots 2"]
    colour: Float[Arrayish, "shots n 3"]
    rate: Float[Arrayish, "shots n"]
    known: Float[Arrayish, "shots n"]
    noise_per_rate: Float[Arrayish, "shots n"]
    weight: Float[Arrayish, "shots n"]
    correction: Float[Arrayish, "shots n"]
    overlap_slope: Float[Arrayish, "shots n"]
    pitch_slope: Float[Arrayish, "shots n"]
    overlaps_pupil_mm: Float[Arrayish, ""]
    overlaps_pitch_mm: Float[Arrayish, ""]
    disc_px: Float[Arrayish, ""]
    index: Int[Arrayish, " shots"]


def picked(block: Block, samples: Int[np.ndarray, "shots_or_1 m"]) -> Block:
    """The block with these samples of every shot alone, by number; one row of them serves all shots."""
    shots = np.arange(np.shape(block.rate)[0])[:, None]
    return replace(block, **{name: np.asarray(getattr(block, name))[shots, samples] for name in _BY_SAMPLE})


class Local(eqx.Module):
    """Shot by shot: (x, y) in px from the place first assumed, light per colour and background in e-/s."""

    offset_px: Float[Arrayish, "shots 2"]
    flux: Float[Arrayish, "shots 3"]
    background: Float[Arrayish, " shots"]


def pack(model: Diffraction) -> Float[np.ndarray, " p"]:
    """Global parameters as one vector: pitch, open fractions, thickness, pupil, log blur, footprint, log spectra.

    The kernel depends on the square of the blur: about none at all it would have no slope, and two signs.
    """
    logs = np.log(np.maximum(np.asarray(model.spectrum), 1e-6))
    head = [model.pitch_mm, *np.asarray(model.open_fraction), model.thickness_mm, model.pupil_mm, np.log(model.blur_px)]
    head += [*np.asarray(model.offset), model.standoff_per_pitch]
    return np.concatenate([np.array(head, dtype=float), (logs - logs.mean(axis=1, keepdims=True)).ravel()])


def unpack(theta: Float[Arrayish, " p"], wavelengths_nm: Float[Arrayish, " nodes"], interference: bool) -> Diffraction:
    """The model that a vector of global parameters stands for."""
    theta = jnp.asarray(theta)
    return Diffraction(
        pitch_mm=theta[0],
        open_fraction=theta[1:3],
        thickness_mm=theta[3],
        pupil_mm=theta[4],
        blur_px=jnp.exp(theta[BLUR]),
        offset=theta[6:8],
        standoff_per_pitch=theta[8],
        visibility=float(interference),
        wavelengths_nm=jnp.asarray(wavelengths_nm),
        spectrum=jax.nn.softmax(theta[HEAD:].reshape(3, -1), axis=1),
    )


def corrected(block: Block, theta: Float[Arrayish, " p"], unit: Float[Arrayish, "shots n"]) -> Float[Array, "shots n"]:
    """Light per unit with what the lattice's kernel at the mean place, and with fixed overlaps, does not have."""
    theta = jnp.asarray(theta)
    by_pupil = jnp.asarray(block.overlap_slope) * (theta[PUPIL] - jnp.asarray(block.overlaps_pupil_mm))
    by_pitch = jnp.asarray(block.pitch_slope) * (theta[PITCH] - jnp.asarray(block.overlaps_pitch_mm))
    return jnp.asarray(unit) + jnp.asarray(block.correction) + by_pupil + by_pitch


_frame = eqx.filter_jit(local_frame)
_points = eqx.filter_jit(lattice_points)


def blocks(shots: Shots, geometry: Geometry, chosen: Bool[np.ndarray, "shots rows columns"]) -> tuple[Block, ...]:
    """Samples to fit, grouped by field position, all groups of one shape."""
    groups = [np.flatnonzero(shots.position == g) for g in range(int(shots.position.max()) + 1)]
    count = max(len(g) for g in groups)
    samples = int(chosen.sum(axis=(1, 2)).max())
    return tuple(_block(shots, geometry, chosen, group, count, samples) for group in groups)


def _block(
    shots: Shots,
    geometry: Geometry,
    chosen: np.ndarray,
    group: np.ndarray,
    count: int,
    samples: int,
) -> Block:
    place = shots.centre_px[group].mean(axis=0)
    frame = _frame(geometry, place)
    offsets = np.zeros((count, samples, 2))
    rate, weight, slope = (np.zeros((count, samples)) for _ in range(3))
    colour = np.zeros((count, samples, 3))
    index = np.full(count, -1)
    index[: len(group)] = group
    grid = shots.offsets()
    for i, shot in enumerate(group):
        mask = chosen[shot]
        n = int(mask.sum())
        offsets[i, :n] = grid[mask] + shots.origin_px[shot] - place
        rate[i, :n], weight[i, :n] = shots.rate[shot][mask], shots.weight[shot][mask]
        slope[i, :n] = shots.noise_per_rate[shot][mask]
        colour[i, :n] = np.eye(3)[shots.channel[shot][mask]]
    begun = np.zeros((count, 2))
    begun[: len(group)] = shots.centre_px[group] - place
    points, density = _points(geometry, frame, place, offsets.reshape(-1, 2))
    moved, _ = _points(geometry, frame, place, begun)
    scale = jnp.abs(jnp.diagonal(frame.jacobian))
    return Block(
        frame=frame,
        points=np.asarray(points).reshape(count, samples, 2) - np.asarray(moved)[:, None],
        density=np.asarray(density).reshape(count, samples),
        slope=frame.jacobian / scale[:, None],
        begun_px=begun,
        colour=colour,
        rate=rate,
        known=weight,
        noise_per_rate=slope,
        weight=weight,
        correction=np.zeros_like(rate),
        overlap_slope=np.zeros_like(rate),
        pitch_slope=np.zeros_like(rate),
        overlaps_pupil_mm=0.0,
        overlaps_pitch_mm=0.0,
        disc_px=float(shots.disc_px[group].mean()),
        index=index,
    )


def fit_lattice(half: tuple[int, int]) -> Lattice:
    """Lattice that holds windows of ``half`` (rows, columns) to either side, sources off the middle included."""
    rows, columns = (2 * h + 9 for h in half)
    return lattice_for(rows * _MARGIN, columns * _MARGIN, _PER_PX, _PER_PX)


def at_places(shots: Shots, offsets_px: Float[np.ndarray, "shots 2"]) -> Shots:
    """Shots whose LED is known to be ``offsets_px`` away from where it was first assumed."""
    return replace(shots, centre_px=shots.centre_px + offsets_px)
