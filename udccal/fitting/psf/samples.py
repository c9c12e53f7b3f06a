"""The samples of all field positions: their weights, the light of a kernel, and each shot's own parameters.

Own parameters of a shot are (x, y) in px from the first assumed place, light per colour and background in e-/s.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Final, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from udccal.fitting.engine.gaussian import scaled_inverse
from udccal.fitting.psf.data import HUBER, PsfRules, Shots, held_out_positions, left_out, noise_at
from udccal.fitting.psf.kernel import Evaluator
from udccal.models.arrays import Arrayish
from udccal.models.diffraction import LocalFrame, local_frame
from udccal.models.geometry import Geometry
from udccal.models.lattice import sample
from udccal.models.psf import lattice_points

OWN: Final = 6
_PER_SAMPLE: Final = (
    *("points", "density", "colour", "rate", "known", "noise_per_rate", "weight", "correction", "by_overlaps"),
)
# Parameters of diffraction; own parameters and light of the shots of one position, and of all positions.
Theta = Float[np.ndarray, " p"]
Own = Float[np.ndarray, "shots l"]
Light = Float[np.ndarray, "shots n"]
Owns = Float[np.ndarray, "positions shots l"]
Lights = Float[np.ndarray, "positions shots n"]


@final
class Samples(eqx.Module):
    """The chosen samples of all shots, by field position (no such axis for one position); padding has weights of 0.

    Attributes:
        points, density: samples on the lattice about the mean place; see ``models.psf.lattice_points``.
        slope: lattice units per pixel, to move a source.
        begun_px: (x, y) of the shots from the mean place, as first assumed.
        colour: each sample's colour (one-hot).
        known: inverse variance of a sample as measured, 0 where there is no sample.
        noise_per_rate: derivative of that variance by the light, in (e-/s)^2 per e-/s.
        weight: inverse variance that the fit uses.
        correction: light that a shot has in addition because the pupil's footprint lies elsewhere on the rows than at
            the mean place, per unit of light of a sample's colour.
        by_overlaps: derivative of interference by the pitch and by the pupil through overlaps, per mm and unit of
            light. overlaps_at: pitch and pupil (mm) at which ``overlaps`` were computed.
        overlaps: of ``kernel.overlaps_of``; if empty, they are computed from the current parameters.
        index: of the shots, -1 for padding.
    """

    frame: LocalFrame
    points: Float[np.ndarray, "*positions shots n 2"]
    density: Float[np.ndarray, "*positions shots n"]
    slope: Float[np.ndarray, "*positions 2 2"]
    begun_px: Float[np.ndarray, "*positions shots 2"]
    colour: Float[np.ndarray, "*positions shots n 3"]
    rate: Float[np.ndarray, "*positions shots n"]
    known: Float[np.ndarray, "*positions shots n"]
    noise_per_rate: Float[np.ndarray, "*positions shots n"]
    weight: Float[np.ndarray, "*positions shots n"]
    correction: Float[np.ndarray, "*positions shots n"]
    by_overlaps: Float[np.ndarray, "*positions shots n 2"]
    overlaps_at: Float[np.ndarray, "*positions 2"]
    overlaps: Float[np.ndarray, "*positions nodes terms rows half"]
    disc_px: Float[Arrayish, "*positions"]
    index: Int[np.ndarray, "*positions shots"]

    def at(self, which: int | slice) -> Samples:
        """Return the samples of one position, or of several."""
        return jax.tree.map(lambda part: part[which], self)

    def about(self, shots: Int[np.ndarray, " k"], samples: Int[np.ndarray, "#k few"]) -> Samples:
        """Return some samples of some shots, of one position."""
        of_shots = {name: getattr(self, name)[shots] for name in ("begun_px", "index")}
        return replace(self, **of_shots, **{name: getattr(self, name)[shots[:, None], samples] for name in _PER_SAMPLE})

    def each(self) -> list[Samples]:
        """Return the samples of every position."""
        return [self.at(position) for position in range(len(self.index))]


def some_shots(shots: Shots, rules: PsfRules) -> Bool[np.ndarray, " shots"]:
    """Choose shots for the fit of diffraction, evenly over the positions not held out and over their shifts."""

    def spread(items: np.ndarray, most: int) -> np.ndarray:
        return items[np.unique(np.linspace(0, len(items) - 1, most).round().astype(int))]

    keep = np.zeros(shots.count, dtype=bool)
    for place in spread(np.flatnonzero(~held_out_positions(shots.positions)), rules.positions):
        keep[spread(np.flatnonzero(shots.position == place), rules.shifts)] = True
    return keep


def choose_samples(shots: Shots, rules: PsfRules) -> Bool[np.ndarray, "shots rows columns"]:
    """Return which samples are fitted: all near the peak and a seeded draw of the others, as many in every shot."""
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
    """Return how many samples of a picture each chosen one represents: 1 near the peak, more where it was drawn."""
    chosen, near = choose_samples(shots, rules), choose_samples(shots, replace(rules, far_fraction=0.0))
    return np.where(near[chosen].reshape(shots.count, -1), 1.0, 1.0 / rules.far_fraction)


@eqx.filter_jit
def _block(geometry: Geometry, place: Float[Arrayish, "2"], offsets_px: Float[Arrayish, "m 2"]) -> tuple[Any, ...]:
    frame = local_frame(geometry, place)
    return frame, *lattice_points(geometry, frame, place, jnp.asarray(offsets_px))


def _on_lattice(
    geometry: Geometry, place: Float[np.ndarray, "2"], offsets_px: Float[np.ndarray, "m 2"]
) -> tuple[LocalFrame, Float[np.ndarray, "m 2"], Float[np.ndarray, " m"]]:
    """Return a place's frame and pixels near it on its lattice, in blocks of one size that share a compilation."""
    count, size = len(offsets_px), 2048
    blocks = np.pad(offsets_px, ((0, -count % size), (0, 0))).reshape(-1, size, 2)
    made = [jax.tree.map(np.asarray, _block(geometry, place, block)) for block in blocks]
    points, density = (np.concatenate([one[part] for one in made])[:count] for part in (1, 2))
    return made[0][0], points, density


def gather(shots: Shots, geometry: Geometry, chosen: Bool[np.ndarray, "shots rows columns"]) -> Samples:
    """Arrange the chosen samples by field position, without overlaps; there are as many in every shot."""
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
    made = [_on_lattice(geometry, place, offset) for place, offset in zip(places, together, strict=True)]
    frame, points, density = jax.tree.map(lambda *parts: np.stack(parts), *made)
    size, weight = away.shape[:3], taken(shots.weight) * (index >= 0)[..., None]
    scale = np.abs(np.diagonal(frame.jacobian, axis1=1, axis2=2))
    return Samples(
        frame=frame,
        points=points[:, :-most].reshape(*size, 2) - points[:, -most:, None],
        density=density[:, :-most].reshape(size),
        slope=frame.jacobian / scale[..., None],
        begun_px=begun,
        colour=taken(shots.colour) * (index >= 0)[..., None, None],
        rate=taken(shots.rate).astype(np.float64),
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
    """Return the variance of the samples' noise if their true rate is ``level``; 1 where there is no sample."""
    measured = 1.0 / np.where(samples.known > 0, samples.known, 1.0)
    return noise_at(level, samples.rate, measured, samples.noise_per_rate * (samples.known > 0))


def weighed(
    samples: Samples, model_error: float, light: np.ndarray | None = None, background: np.ndarray | float = 0.0
) -> Samples:
    """Return the samples with weights at the expected ``light`` and ``background`` (e-/s), or at the data."""
    seen = samples.known > 0
    light = samples.rate if light is None else light
    variance = sensor_variance(samples, light + background) + left_out(light * seen, model_error) ** 2
    return replace(samples, weight=np.where(seen, 1.0 / variance, 0.0))


def sampled(
    evaluator: Evaluator, one: Samples, coefficients: Float[np.ndarray, "y x c"], offset_px: Float[np.ndarray, "k 2"]
) -> Float[np.ndarray, "shots n c"]:
    """Return each sample's light per unit of the LED's light at one position, for every kernel of the coefficients."""
    points = one.points - (offset_px @ one.slope.T)[:, None]
    values = sample(evaluator.lattice, coefficients, points.reshape(-1, 2)).reshape(*points.shape[:2], -1)
    return np.asarray(values * one.density[..., None])


def unit_light(
    evaluator: Evaluator,
    one: Samples,
    offset_px: Float[np.ndarray, "shots 2"],
    coefficients: Float[np.ndarray, "y x 3"],
) -> Light:
    """Return each sample's light per unit of light of its own colour, at one position and without corrections."""
    return np.einsum("snc,snc->sn", sampled(evaluator, one, coefficients, offset_px), one.colour)


def flux_of(samples: Samples, own: Float[np.ndarray, "*k l"]) -> Float[np.ndarray, "*k n"]:
    """Return the LED's light in each sample's own colour, in e-/s."""
    return np.einsum("...snc,...sc->...sn", samples.colour, own[..., 2:5])


def own_slopes(
    evaluator: Evaluator,
    one: Samples,
    own: Own,
    coefficients: Float[np.ndarray, "y x 3"],
    here: Light,
    changed: Light | float = 0.0,
) -> Float[np.ndarray, "shots n l"]:
    """Derivatives of one position's light by each shot's own parameters.

    ``here`` is the light per unit by the ``coefficients`` at the shots' places; ``changed`` is what is added to it.
    """
    # Differences over a 250th of the lattice's spacing: a cubic spline has no more detail.
    step, offset = 1e-3, own[:, :2]
    ahead = [unit_light(evaluator, one, offset + step * move, coefficients) for move in np.eye(2)]
    by_move = (np.stack(ahead, axis=-1) - here[..., None]) / step
    flux, unit = flux_of(one, own)[..., None], here + changed
    return np.concatenate([flux * by_move, unit[..., None] * one.colour, np.ones_like(flux)], axis=-1)


def huber_weight(residual: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return weights of squared residuals in a step, those of Huber's loss."""
    return np.asarray(weight * np.minimum(1.0, HUBER.sigma / np.maximum(np.abs(residual) * np.sqrt(weight), 1e-12)))


def start_own(evaluator: Evaluator, one: Samples, kernel: Float[np.ndarray, "y x 3"]) -> Own:
    """Start own parameters of one position's shots: the best of a grid of places, light and background linear in it.

    A centroid is not accurate enough. Neighbouring diffraction orders are half as bright as the middle one, and the
    mosaic samples each colour unevenly: it can be off by a pixel, and a descent then ends on a neighbouring order.
    """
    moves = np.stack(np.meshgrid(*2 * (np.linspace(-1.25, 1.25, 11),)), axis=-1).reshape(-1, 2)
    # Places are compared on the samples about the brightest spot; 117 of them are enough.
    shots = np.arange(len(one.rate))
    core = np.argsort((one.points**2).sum(axis=-1), axis=-1, kind="stable")[:, :117]
    near = one.about(shots, core)
    # At all places at once.
    every = near.about(np.tile(shots, len(moves)), np.arange(core.shape[1])[None])
    units = unit_light(evaluator, every, np.repeat(moves, len(shots), axis=0), kernel)
    units = units.reshape(len(moves), *core.shape)
    offset = moves[_linear(near, units)[1].argmin(axis=0)]
    light, _ = _linear(one, unit_light(evaluator, one, offset, kernel)[None])
    return np.concatenate([offset, light[0]], axis=-1)


def _linear(
    one: Samples, units: Float[np.ndarray, "moves shots n"]
) -> tuple[Float[np.ndarray, "moves shots 4"], Float[np.ndarray, "moves shots"]]:
    """Fit light per colour and background of the shots for each of several expectations; return them and the cost."""
    rate, weight, colour = one.rate, one.weight, one.colour
    # Far from the solution, the model error is a tenth of the signal or more.
    variance = 1.0 / np.where(weight > 0, weight, 1.0) + (0.1 * np.maximum(rate, 0.0)) ** 2
    root = np.where(weight > 0, 1.0 / np.sqrt(variance), 0.0)
    design = np.concatenate([units[..., None] * colour, np.ones((*units.shape, 1))], axis=-1) * root[..., None]
    data, across = (rate * root)[..., None], np.swapaxes(design, -1, -2)
    solution = scaled_inverse(across @ design) @ (across @ data)
    # Without the bound a place where nothing is expected would fit a dark neighbourhood best.
    left = np.minimum(np.abs(data - design @ solution), 10.0)
    return solution[..., 0], (left[..., 0] ** 2).sum(axis=-1)
