"""The light that diffraction brings to samples, its normal equations, and both as a problem for the engine's solver.

Own parameters of a shot are (x, y) in px from the first assumed place, light per colour and background in e-/s.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, final

import jax
import numpy as np
from jaxtyping import Bool, Float
from scipy.special import softmax

from udccal.fitting.engine.gaussian import Prior, scaled_inverse
from udccal.fitting.engine.least_squares import Blocks, Step
from udccal.fitting.psf.data import HUBER, Crops, Shots
from udccal.fitting.psf.image import Sources
from udccal.fitting.psf.kernel import (
    BLUR,
    FOOTPRINT,
    HEAD,
    PITCH,
    PUPIL,
    Evaluator,
    fit_lattice,
    kernel_coefficients,
    kernel_jacobian,
    overlaps_of,
)
from udccal.fitting.psf.samples import (
    OWN,
    Light,
    Lights,
    Own,
    Owns,
    Samples,
    Theta,
    flux_of,
    gather,
    huber_weight,
    own_slopes,
    sampled,
    start_own,
    unit_light,
    weighed,
)
from udccal.models.geometry import Geometry
from udccal.numerics import in_two_threads

# Overlaps of the pupil's footprint change with these parameters.
_IN_OVERLAPS: Final = np.array([PITCH, PUPIL])
# The pitch, both openings and the pupil's diameter: none of them is 0 or less.
_POSITIVE: Final = np.array([PITCH, 1, 2, PUPIL])


@final
@dataclass(frozen=True)
class Place:
    """A descent's current parameters: those of diffraction, which are shared, and those of every shot.

    ``light`` is that of the samples, in e-/s without background, with its derivatives; those may be of a place nearby.
    """

    theta: Float[np.ndarray, " p"]
    own: Owns
    light: Lights
    by_theta: Float[np.ndarray, "positions shots n p"]
    by_own: Float[np.ndarray, "positions shots n l"]


@final
@dataclass(frozen=True)
class DiffractionProblem:
    """Diffraction for the engine's solver; the groups of its equations are the shots, position after position.

    Interference depends on the place of the pupil's footprint and on its overlaps, which take long to compute. It is
    therefore set up about one place, with its changes around that place to first order. Shared parameters that are
    ``held`` make no step.
    """

    samples: Samples
    evaluator: Evaluator
    prior: Prior
    held: Bool[np.ndarray, " p"] | None = None
    name: str = "psf"

    @property
    def used(self) -> int:
        """Number of samples that are used."""
        return int((self.samples.weight > 0).sum())

    @property
    def unknowns(self) -> int:
        """Number of parameters, those of each shot included."""
        return self.prior.mean.size + OWN * int((self.samples.index >= 0).sum())

    def at(self, theta: Theta, own: Owns, near: Place | None = None) -> Place:
        """Return the place of these parameters, with the derivatives of a place ``near`` it, or with its own."""

        def lit(part: tuple[Samples, Own]) -> tuple[np.ndarray, ...]:
            return _lit(self.evaluator, theta, *part, near is None)

        parts = in_two_threads(lit, zip(self.samples.each(), own, strict=True))
        light, *derivatives = (np.stack(one) for one in zip(*parts, strict=True))
        if near is not None:
            derivatives = [near.by_theta, near.by_own]
        return Place(theta, own, light, *derivatives)

    def by_position(self, place: Place) -> list[Blocks]:
        """Return each position's part of the Gauss-Newton equations with Huber's weights, without the prior."""
        weight, residual = self.samples.weight, self.samples.rate - place.light - place.own[..., 5:]
        losses = HUBER.loss(residual * np.sqrt(weight))
        huber, made = huber_weight(residual, weight), []
        for i, (by_theta, by_own) in enumerate(zip(place.by_theta, place.by_own, strict=True)):
            weighted, across = by_theta * huber[i, ..., None], np.swapaxes(by_own * huber[i, ..., None], 1, 2)
            flat = by_theta.reshape(-1, by_theta.shape[-1])
            shared, right = weighted.reshape(flat.shape).T @ flat, np.tensordot(residual[i], weighted, 2)
            own_right, cross = (across @ residual[i, ..., None])[..., 0], np.swapaxes(across @ by_theta, 1, 2)
            count = int((weight[i] > 0).sum())
            made.append(Blocks(float(losses[i].sum()), count, shared, right, across @ by_own, own_right, cross))
        return made

    def equations_at(self, place: Place) -> Blocks:
        """Return cost and normal equations, with the prior's.

        Light changes with the blur's square, v = exp(2 l). Where data ask for less blur than none, the curvature that
        Gauss and Newton leave out, (d chi2 / dv) d2v / dl2 = 2 d chi2 / dl, is most of it; steps without it go astray.
        """
        data = Blocks.joined(self.by_position(place))
        data.shared[BLUR, BLUR] += max(-2.0 * data.right[BLUR], 0.0)
        return replace(data, held=self.held).with_prior(self.prior, place.theta)

    def moved(self, place: Place, step: Step) -> Place:
        """Return the place after a step."""
        theta, own = stepped(place.theta, step.shared), moved_own(place.own, step.own.reshape(place.own.shape))
        # The gain is the square of the step's length in sigmas: derivatives hardly change over five of them.
        return self.at(theta, own, place if step.gain < 25.0 else None)

    def light_of_average(self, place: Place) -> Lights:
        """Return the light averaged over the footprint's place, without interference."""
        samples = self.samples
        none = {name: np.zeros_like(getattr(samples, name)) for name in ("overlaps", "correction", "by_overlaps")}
        return replace(self, samples=replace(samples, **none)).at(place.theta, place.own, place).light

    def errors(self, place: Place) -> Lights:
        """Return data less expectation in units of sigma, 0 for unused samples."""
        return (self.samples.rate - place.light - place.own[..., 5:]) * np.sqrt(self.samples.weight)

    def with_overlaps(self, theta: Float[np.ndarray, " p"]) -> DiffractionProblem:
        """Set the overlaps to those of ``theta``: they hardly change in a descent."""

        def overlaps(one: Samples) -> np.ndarray:
            return np.asarray(overlaps_of(self.evaluator, theta, one.frame))

        found = in_two_threads(overlaps, self.samples.each())
        return replace(self, samples=replace(self.samples, overlaps=np.stack(found)))

    def about(self, theta: Theta, own: Owns, near: bool = False) -> DiffractionProblem:
        """Set interference up about these parameters; ``near`` the last ones, derivatives by overlaps stay."""
        if not self.evaluator.interference:
            return self.with_overlaps(theta)

        def set_up(part: tuple[Samples, Own]) -> Samples:
            return _set_up(self.evaluator, theta, *part, near)

        made = in_two_threads(set_up, zip(self.samples.each(), own[..., :2], strict=True))
        return replace(self, samples=jax.tree.map(lambda *parts: np.stack(parts), *made))


def _lit(evaluator: Evaluator, theta: Theta, one: Samples, own: Own, with_slopes: bool) -> tuple[np.ndarray, ...]:
    """Return the light of one position's samples, and its derivatives by shared and own parameters if wanted.

    A shot's own place and the overlaps change the light to first order.
    """
    kernel = kernel_of(evaluator, theta, one)
    here = unit_light(evaluator, one, own[:, :2], kernel)
    changed = one.correction + one.by_overlaps @ (theta[_IN_OVERLAPS] - one.overlaps_at)
    light = (here + changed) * flux_of(one, own)
    if not with_slopes:
        return (light,)
    return light, slopes(evaluator, theta, one, own), own_slopes(evaluator, one, own, kernel, here, changed)


def stepped(theta: Float[np.ndarray, " p"], step: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
    """Return parameters after a step; spectra grow by the step itself, not by its exponential.

    Lengths and openings stay positive: they at most halve, or double.
    """
    spectra = softmax(theta[HEAD:].reshape(3, -1), axis=1)
    logs = step[HEAD:].reshape(3, -1)
    mean = np.sum(spectra * logs, axis=1, keepdims=True)
    grown = logs - mean
    grown = np.where(grown > 0, np.log1p(np.maximum(grown, 0.0)), grown)
    moved = theta + np.concatenate([step[:HEAD], (mean + grown).ravel()])
    moved[_POSITIVE] = np.clip(moved[_POSITIVE], 0.5 * theta[_POSITIVE], 2.0 * theta[_POSITIVE])
    return moved


def moved_own(own: Float[np.ndarray, "*k l"], step: Float[np.ndarray, "*k l"]) -> Float[np.ndarray, "*k l"]:
    """Return own parameters after a step; places of LEDs move by half a pixel at most."""
    return own + np.concatenate([np.clip(step[..., :2], -0.5, 0.5), step[..., 2:]], axis=-1)


def kernel_of(evaluator: Evaluator, theta: Theta, one: Samples) -> Float[np.ndarray, "y x 3"]:
    """Return the kernel's spline coefficients at one position."""
    return np.asarray(kernel_coefficients(evaluator, theta, one.frame, one.disc_px, one.overlaps))


def _set_up(
    evaluator: Evaluator, theta: Theta, one: Samples, offset_px: Float[np.ndarray, "shots 2"], near: bool
) -> Samples:
    """Return one position's samples with interference set up about these parameters; see ``Samples``."""
    one = replace(one, overlaps=np.asarray(overlaps_of(evaluator, theta, one.frame)), overlaps_at=theta[_IN_OVERLAPS])

    def light(theta: Theta, overlaps: np.ndarray) -> Light:
        return unit_light(evaluator, one, offset_px, kernel_of(evaluator, theta, replace(one, overlaps=overlaps)))

    here = light(theta, one.overlaps)
    # The pupil's footprint moves with a shot's own place.
    slope = one.frame.direction[:2] / one.frame.direction[2]
    tangent = (np.eye(2) + np.outer(slope, slope)) / one.frame.direction[2]
    along = theta[FOOTPRINT][2] * (one.begun_px + offset_px) @ (tangent @ one.frame.jacobian).T
    correction = np.zeros_like(here)
    for shot, move in enumerate(along):
        elsewhere = theta.copy()
        elsewhere[FOOTPRINT][:2] += move
        correction[shot] = (light(elsewhere, one.overlaps) - here)[shot]
    if near:
        return replace(one, correction=correction)
    # Overlaps are in single precision: steps of this length (mm) keep their difference precise. Steps ten times as
    # long change derivatives by some per cent.
    by_overlaps = []
    for i, step in zip(_IN_OVERLAPS, (2e-4, 1e-3), strict=True):
        moved = np.asarray(overlaps_of(evaluator, theta + step * np.eye(theta.size)[i], one.frame))
        by_overlaps.append((light(theta, moved) - here) / step)
    return replace(one, correction=correction, by_overlaps=np.stack(by_overlaps, axis=-1))


def slopes(evaluator: Evaluator, theta: Theta, one: Samples, own: Own) -> Float[np.ndarray, "shots n p"]:
    """Return derivatives of the light of one position's samples by the shared parameters."""
    spectra = softmax(theta[HEAD:].reshape(3, -1), axis=1)
    # Single precision takes less time, and its errors are a millionth of a derivative.
    with jax.enable_x64(False):
        made = kernel_jacobian(evaluator, theta, one.frame, one.disc_px, one.overlaps)
        coefficients, chain = (np.asarray(part) for part in made)
    count = spectra.shape[1]
    values = sampled(evaluator, one, coefficients, own[:, :2])
    nodes, by_colour = values[..., :count], values[..., count:].reshape(*values.shape[:2], -1, 3)
    of_colour = one.colour @ spectra
    unit = np.einsum("snj,snj->sn", nodes, of_colour)
    of_own = by_colour * one.colour[:, :, None]
    by_head = of_own.reshape(*unit.shape, -1) @ chain.reshape(-1, chain.shape[-1])
    by_head[..., _IN_OVERLAPS] += one.by_overlaps
    by_logs = one.colour[..., None] * (of_colour * (nodes - unit[..., None]))[..., None, :]
    by_theta = np.concatenate([by_head, by_logs.reshape(*unit.shape, -1)], axis=-1)
    return by_theta * flux_of(one, own)[..., None]


def explain(
    evaluator: Evaluator, theta: Float[np.ndarray, " p"], shots: Shots, geometry: Geometry, model_error: float
) -> tuple[Sources, Crops]:
    """Apply diffraction to whole crops: return place and light of the LEDs, and the samples' light per unit."""
    evaluator = replace(evaluator, lattice=fit_lattice(shots.half))
    samples = weighed(gather(shots, geometry, np.ones(shots.rate.shape, dtype=bool)), model_error)
    found, explained = np.zeros((shots.count, OWN)), np.zeros(shots.rate.shape)

    def fitted(one: Samples) -> tuple[Own, Light]:
        overlaps = np.asarray(overlaps_of(evaluator, theta, one.frame))
        kernel = kernel_of(evaluator, theta, replace(one, overlaps=overlaps))
        own = start_own(evaluator, one, kernel)
        for _ in range(3):
            unit = unit_light(evaluator, one, own[:, :2], kernel)
            by_own = own_slopes(evaluator, one, own, kernel, unit)
            residual = one.rate - unit * flux_of(one, own) - own[:, 5:]
            across = np.swapaxes(by_own * huber_weight(residual, one.weight)[..., None], 1, 2)
            step = scaled_inverse(across @ by_own, 1e-14) @ (across @ residual[..., None])
            own = moved_own(own, step[..., 0])
        return own, unit_light(evaluator, one, own[:, :2], kernel)

    for index, (own, unit) in zip(samples.index, in_two_threads(fitted, samples.each()), strict=True):
        real = index >= 0
        found[index[real]], explained[index[real]] = own[real], unit[real].reshape(-1, *shots.rate.shape[1:])
    sources = Sources(shots.centre_px + found[:, :2], found[:, 2:5], found[:, 5])
    return sources.with_light_of_peak(shots, explained), explained
