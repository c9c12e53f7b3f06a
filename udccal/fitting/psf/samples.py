"""Samples of shots on the lattice of their field position.

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

from udccal.fitting.psf.data import Shots, left_out, noise_at
from udccal.fitting.psf.kernel import Kernel
from udccal.models.arrays import Arrayish
from udccal.models.diffraction import LocalFrame, local_frame
from udccal.models.geometry import Geometry
from udccal.models.psf import lattice_points

OWN: Final = 6
_PER_SAMPLE = ("points", "density", "colour", "rate", "known", "noise_per_rate", "weight", "correction", "by_overlaps")
# Own parameters and light of the shots, of one position or of all.
Own = Float[np.ndarray, "*positions shots l"]
Light = Float[np.ndarray, "*positions shots n"]


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
        correction: light per unit that a shot has in addition because the pupil's footprint lies elsewhere on the rows
            than at the mean place.
        by_overlaps: derivative of interference by pitch and pupil through overlaps, per mm and unit of light.
        overlaps, overlaps_at: see ``Evaluator.overlaps``, empty before they are set; pitch and pupil (mm) there.
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

    def at(self, which: int | slice | Int[np.ndarray, " some"]) -> Samples:
        """Return the samples of one position, or of several."""
        return jax.tree.map(lambda part: part[which], self)

    def each(self) -> list[Samples]:
        """Return the samples of every position."""
        return [self.at(position) for position in range(len(self.index))]

    def without_overlaps(self) -> Samples:
        """Return the samples with overlaps empty, as before they are set."""
        return replace(self, overlaps=np.zeros((len(self.index), 0, 0, 0, 0), dtype=np.float32))

    def nearest(self, count: int) -> Samples:
        """Return so many samples of every shot, of one position: those next to the mean place."""
        order = np.argsort((self.points**2).sum(axis=-1), axis=-1, kind="stable")
        chosen = np.arange(len(order))[:, None], order[:, :count]
        return replace(self, **{name: getattr(self, name)[chosen] for name in _PER_SAMPLE})

    def sensor_variance(self, level: Float[np.ndarray, "*k n"]) -> Float[np.ndarray, "*k n"]:
        """Return the variance of the samples' noise if their true rate is ``level``; 1 where there is no sample."""
        measured = 1.0 / np.where(self.known > 0, self.known, 1.0)
        return noise_at(level, self.rate, measured, self.noise_per_rate * (self.known > 0))

    def weighed(
        self, model_error: float, light: np.ndarray | None = None, background: np.ndarray | float = 0.0
    ) -> Samples:
        """Return the samples with weights at the expected ``light`` and ``background`` (e-/s), or at the data."""
        seen, light = self.known > 0, self.rate if light is None else light
        variance = self.sensor_variance(light + background) + left_out(light * seen, model_error) ** 2
        return replace(self, weight=np.where(seen, 1.0 / variance, 0.0))

    def flux(self, own: Float[np.ndarray, "*k l"]) -> Float[np.ndarray, "*k n"]:
        """Return the LED's light in each sample's own colour, in e-/s."""
        return np.einsum("...snc,...sc->...sn", self.colour, own[..., 2:5])

    def sampled(self, kernel: Kernel, offset_px: Float[np.ndarray, "*moves 2"]) -> Float[np.ndarray, "*moves n c"]:
        """Return each sample's light per unit of the LED's light at one position, for every channel of the kernel.

        The LEDs' offsets from the mean place are of ``shots``, or of any number of moves x shots.
        """
        points = self.points - (offset_px @ self.slope.T)[..., None, :]
        return kernel.at(points) * self.density[..., None]

    def unit_light(self, kernel: Kernel, offset_px: Float[np.ndarray, "*moves 2"]) -> Float[np.ndarray, "*moves n"]:
        """Return each sample's light per unit of light of its own colour, at one position and without corrections."""
        return np.einsum("...snc,snc->...sn", self.sampled(kernel, offset_px), self.colour)

    def own_slopes(
        self, own: Own, kernel: Kernel, here: Light, changed: Light | float = 0.0
    ) -> Float[np.ndarray, "shots n l"]:
        """Return derivatives of one position's light by each shot's own parameters.

        ``here`` is the light per unit by the ``kernel`` at the shots' places; ``changed`` is what is added to it.
        """
        # Differences over a 160th of the lattice's spacing: a cubic spline has no more detail.
        step, flux, unit = 1e-3, self.flux(own)[..., None], here + changed
        ahead = [self.unit_light(kernel, own[:, :2] + step * move) for move in np.eye(2)]
        by_move = (np.stack(ahead, axis=-1) - here[..., None]) / step
        return np.concatenate([flux * by_move, unit[..., None] * self.colour, np.ones_like(flux)], axis=-1)


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
    group, real = np.where(index < 0, index[:, :1], index), (index >= 0)[..., None]

    def taken(values: np.ndarray) -> np.ndarray:
        return values[chosen].reshape(shots.count, -1, *values.shape[3:])[group]

    offsets = np.broadcast_to(shots.offsets(), (*shots.rate.shape, 2))
    away = taken(offsets) + (shots.origin_px[group] - places[:, None])[:, :, None]
    begun, size, weight = shots.centre_px[group] - places[:, None], away.shape[:3], taken(shots.weight) * real
    together = np.concatenate([away.reshape(len(groups), -1, 2), begun], axis=1)
    made = [_on_lattice(geometry, place, offset) for place, offset in zip(places, together, strict=True)]
    frame, points, density = jax.tree.map(lambda *parts: np.stack(parts), *made)
    scale = np.abs(np.diagonal(frame.jacobian, axis1=1, axis2=2))
    return Samples(
        frame=frame,
        points=points[:, :-most].reshape(*size, 2) - points[:, -most:, None],
        density=density[:, :-most].reshape(size),
        slope=frame.jacobian / scale[..., None],
        begun_px=begun,
        colour=taken(shots.colour) * real[..., None],
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
