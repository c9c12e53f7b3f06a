"""The samples of all field positions that a fit of diffraction goes by, and what they count for."""

from __future__ import annotations

from dataclasses import replace
from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from udccal.fitting.psf.data import Shots
from udccal.fitting.psf.start import PsfRules, left_out, noise_at
from udccal.models.arrays import Arrayish
from udccal.models.diffraction import LocalFrame, local_frame
from udccal.models.geometry import Geometry
from udccal.models.psf import lattice_points


@final
class Samples(eqx.Module):
    """The chosen samples of all shots, by field position; positions with fewer shots are padded with weights of 0.

    Of one position alone it has no axis of positions.

    Attributes:
        points, density: samples on the lattice about the mean place; see ``models.psf.lattice_points``.
        slope: lattice units per pixel, to move a source.
        begun_px: (x, y) of the shots from the mean place, as first assumed.
        colour: which of three colours a sample has (one-hot).
        known: inverse variance of a sample as it was measured, 0 where there is none.
        noise_per_rate: by how much that variance grows with the light, in (e-/s)^2 per e-/s.
        weight: inverse variance that the fit goes by.
        correction: per unit of light of a sample's colour, what a shot has more because the pupil's footprint lies
            elsewhere on the rows than at the mean place.
        by_overlaps: by how much interference changes with the pitch and with the pupil because overlaps do, per mm and
            unit of light. overlaps_at: those (mm) that ``overlaps``, of ``kernel.overlaps_of``, are of.
        overlaps: without any, those of the parameters at hand are worked out.
        index: which shots these are, -1 for padding.
    """

    frame: LocalFrame
    points: Float[Arrayish, "*positions shots n 2"]
    density: Float[Arrayish, "*positions shots n"]
    slope: Float[Arrayish, "*positions 2 2"]
    begun_px: Float[Arrayish, "*positions shots 2"]
    colour: Float[Arrayish, "*positions shots n 3"]
    rate: Float[Arrayish, "*positions shots n"]
    known: Float[Arrayish, "*positions shots n"]
    noise_per_rate: Float[Arrayish, "*positions shots n"]
    weight: Float[Arrayish, "*positions shots n"]
    correction: Float[Arrayish, "*positions shots n"]
    by_overlaps: Float[Arrayish, "*positions shots n 2"]
    overlaps_at: Float[Arrayish, "*positions 2"]
    overlaps: Float[Arrayish, "*positions nodes terms rows half"]
    disc_px: Float[Arrayish, "*positions"]
    index: Int[Arrayish, "*positions shots"]

    def at(self, which: int | slice) -> Samples:
        """Those of one position, or of some."""
        return jax.tree.map(lambda part: part[which], self)


def choose_samples(shots: Shots, rules: PsfRules) -> Bool[np.ndarray, "shots rows columns"]:
    """All samples about the peak and a seeded draw of the others in the window of the fit, as many in every shot."""
    rng = np.random.default_rng(2)
    x, y = np.moveaxis(np.abs(shots.offsets()), -1, 0)
    inside = (x <= rules.close_px[1]) & (y <= rules.close_px[0])
    near = (x <= rules.peak_half_px[1]) & (y <= rules.peak_half_px[0]) & inside
    far = np.flatnonzero((inside & ~near).ravel())
    chosen = np.tile(near.ravel(), (shots.count, 1))
    for row in chosen:
        row[rng.choice(far, round(len(far) * rules.far_fraction), replace=False)] = True
    return chosen.reshape(shots.rate.shape)


def stands_for(shots: Shots, rules: PsfRules) -> Float[np.ndarray, "shots n"]:
    """How many samples of its picture each chosen one stands for: those away from the peak were drawn."""
    chosen, near = choose_samples(shots, rules), choose_samples(shots, replace(rules, far_fraction=0.0))
    return np.where(near[chosen].reshape(shots.count, -1), 1.0, 1.0 / rules.far_fraction)


@eqx.filter_jit
def _on_lattice(
    geometry: Geometry, places: Float[Arrayish, "positions 2"], offsets_px: Float[Arrayish, "positions m 2"]
) -> tuple[LocalFrame, Float[Array, "positions m 2"], Float[Array, "positions m"]]:
    """Frames of places, and where pixels beside them lie on their lattices."""

    def one(at: tuple[Array, Array]) -> tuple[LocalFrame, Array, Array]:
        frame = local_frame(geometry, at[0])
        return frame, *lattice_points(geometry, frame, *at)

    return jax.lax.map(one, (jnp.asarray(places), jnp.asarray(offsets_px)))


def gather(shots: Shots, geometry: Geometry, chosen: Bool[np.ndarray, "shots rows columns"]) -> Samples:
    """Chosen samples by field position, without overlaps.

    Args:
        shots: the data, positions numbered without gaps.
        geometry: where pixels look.
        chosen: as many samples in every shot.
    """
    groups = [np.flatnonzero(shots.position == g) for g in range(shots.positions)]
    most, places = max(len(group) for group in groups), shots.positions_px()
    index = np.stack([np.pad(group, (0, most - len(group)), constant_values=-1) for group in groups])
    # Padding has the place and the light of a position's first shot, but no weight.
    group = np.where(index < 0, index[:, :1], index)

    def taken(values: np.ndarray) -> np.ndarray:
        return values[chosen].reshape(shots.count, -1, *values.shape[3:])[group]

    offsets = np.broadcast_to(shots.offsets(), (*shots.rate.shape, 2))
    away = taken(offsets) + (shots.origin_px[group] - places[:, None])[:, :, None]
    begun = shots.centre_px[group] - places[:, None]
    together = np.concatenate([away.reshape(len(groups), -1, 2), begun], axis=1)
    frame, points, density = jax.tree.map(np.asarray, _on_lattice(geometry, places, together))
    size, weight = away.shape[:3], taken(shots.weight) * (index >= 0)[..., None]
    scale = np.abs(np.diagonal(frame.jacobian, axis1=1, axis2=2))
    return Samples(
        frame=frame,
        points=points[:, :-most].reshape(*size, 2) - points[:, -most:, None],
        density=density[:, :-most].reshape(size),
        slope=frame.jacobian / scale[..., None],
        begun_px=begun,
        colour=taken(shots.colour) * (index >= 0)[..., None, None],
        rate=taken(shots.rate),
        known=weight,
        noise_per_rate=taken(shots.noise_per_rate),
        weight=weight,
        correction=np.zeros(size),
        by_overlaps=np.zeros((*size, 2)),
        overlaps_at=np.zeros((len(groups), 2)),
        overlaps=np.zeros((len(groups), 0, 0, 0, 0), dtype=np.float32),
        disc_px=np.array([shots.disc_px[group].mean() for group in groups]),
        index=index,
    )


def sensor_variance(samples: Samples, level: Float[np.ndarray, "*k n"]) -> Float[np.ndarray, "*k n"]:
    """Variance of the samples' noise if their true rate is ``level``; 1 where there is no sample."""
    known, rate = np.asarray(samples.known), np.asarray(samples.rate)
    measured = 1.0 / np.where(known > 0, known, 1.0)
    return noise_at(level, rate, measured, np.asarray(samples.noise_per_rate) * (known > 0))


def weighed(
    samples: Samples, model_error: float, light: np.ndarray | None = None, background: np.ndarray | float = 0.0
) -> Samples:
    """With weights at the ``light`` and ``background`` that a model expects, in e-/s; before there is one, at the data.

    Args:
        samples: the data.
        model_error: relative to the peak of each picture; see ``left_out``.
        light: of each sample.
        background: broadcast to samples.
    """
    seen = np.asarray(samples.known) > 0
    light = np.asarray(samples.rate) if light is None else light
    variance = sensor_variance(samples, light + background) + left_out(light * seen, model_error) ** 2
    return replace(samples, weight=np.where(seen, 1.0 / variance, 0.0))
