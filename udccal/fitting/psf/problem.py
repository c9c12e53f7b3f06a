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
    CORNER,
    FOOTPRINT,
    HEAD,
    PITCH,
    PUPIL,
    SLANT,
    Evaluator,
    Kernel,
    Theta,
    fit_lattice,
)
from udccal.fitting.psf.samples import OWN, Light, Own, Samples, gather
from udccal.models.geometry import Geometry
from udccal.models.interference import TERMS
from udccal.numerics import in_two_threads

# Overlaps of the pupil's footprint change with these parameters.
_IN_OVERLAPS: Final = np.array([PITCH, PUPIL])
# What of samples is set up about a place, beside the overlaps.
_SET_UP: Final = ("correction", "by_overlaps", "overlaps_at")
# The pitch, both openings and the pupil's diameter: none of them is 0 or less.
_POSITIVE: Final = np.array([PITCH, 1, 2, PUPIL])
# Logarithms of the corners' radius and of slants.
_SHAPES: Final = slice(CORNER, SLANT.stop)
# Light is nearly linear in these powers of the blur, the corners' radius and slants; 0 for parameters that are no
# logarithms.
_POWERS: Final = np.zeros(HEAD)
_POWERS[BLUR], _POWERS[CORNER], _POWERS[SLANT] = 2.0, 2.0, 1.0


@final
@dataclass(frozen=True)
class Place:
    """A descent's current parameters: those of diffraction, which are shared, and those of every shot.

    ``light`` is that of the samples, in e-/s without background, with its derivatives; those may be of a place nearby.
    """

    theta: Float[np.ndarray, " p"]
    own: Own
    light: Light
    by_theta: Float[np.ndarray, "positions shots n p"]
    by_own: Float[np.ndarray, "positions shots n l"]

    @property
    def level(self) -> Light:
        """The samples' light and background."""
        return self.light + self.own[..., 5:]


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

    def at(self, theta: Theta, own: Own, near: Place | None = None, far: bool = False) -> Place:
        """Return the place of these parameters, with its own derivatives, or with those of a place ``near`` it.

        Derivatives take most of the time. Where that place is ``far``, they are made if the cost is lower than there:
        a step that is not taken needs none.
        """
        parts = list(zip(self.samples.each(), own, strict=True))

        def lit(part: tuple[Samples, Own]) -> tuple[Kernel, Light, Light]:
            one, own = part
            kernel = kernel_of(self.evaluator, theta, one)
            # A shot's own place and the overlaps change the light to first order.
            changed = one.correction + one.by_overlaps @ (theta[_IN_OVERLAPS] - one.overlaps_at)
            return kernel, one.unit_light(kernel, own[:, :2]), changed

        def sloped(part: tuple[tuple[Samples, Own], tuple[Kernel, Light, Light]]) -> tuple[np.ndarray, np.ndarray]:
            (one, own), (kernel, here, changed) = part
            return _slopes(self.evaluator, theta, one, own), one.own_slopes(own, kernel, here, changed)

        found = in_two_threads(lit, parts)
        light = np.stack([(here + by) * one.flux(at) for (one, at), (_, here, by) in zip(parts, found, strict=True)])
        if near is not None:
            by_theta = _by_grown(near.by_theta, theta[_SHAPES] - near.theta[_SHAPES])
            place = Place(theta, own, light, by_theta, near.by_own)
            if not far or self._cost(place) >= self._cost(near):
                return place
        derivatives = in_two_threads(sloped, zip(parts, found, strict=True))
        return Place(theta, own, light, *(np.stack(one) for one in zip(*derivatives, strict=True)))

    def _cost(self, place: Place) -> float:
        return float(HUBER.loss(self.errors(place)).sum()) + self.prior.cost(place.theta)

    def by_position(self, place: Place) -> list[Blocks]:
        """Return each position's part of the Gauss-Newton equations with Huber's weights, without the prior."""
        weight, residual, made = self.samples.weight, self.samples.rate - place.level, []
        losses, huber = HUBER.loss(residual * np.sqrt(weight)), _huber_weight(residual, weight)
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

        Light changes with powers, v = exp(k l), of the blur and of shapes. Where data ask for less than none of one,
        the curvature that Gauss and Newton leave out, k d chi2 / dl, is most of it; steps without it go astray.
        """
        data = Blocks.joined(self.by_position(place))
        stiffer = np.pad(_POWERS * np.maximum(-data.right[:HEAD], 0.0), (0, data.right.size - HEAD))
        return replace(data, held=self.held, stiffer=stiffer).with_prior(self.prior, place.theta)

    def moved(self, place: Place, step: Step) -> Place:
        """Return the place after a step."""
        theta, own = stepped(place.theta, step.shared), _moved_own(place.own, step.own.reshape(place.own.shape))
        # The gain is the square of the step's length in sigmas: derivatives hardly change over five of them.
        return self.at(theta, own, place, far=step.gain >= 25.0)

    def with_dropped_begun_again(self, place: Place, model_error: float) -> Place:
        """Return the place with own parameters of pictures without weight as their samples alone have them.

        A picture that was dropped far from the minimum does not move with the others, and would stay dropped.
        """
        dropped = (self.samples.index >= 0) & ~self.samples.weight.any(axis=-1)
        if not dropped.any():
            return place
        own, groups = place.own.copy(), np.flatnonzero(dropped.any(axis=1))
        for group in groups.tolist():
            one = self.samples.at(group).weighed(model_error)
            own[group, dropped[group]] = _own_alone(one, kernel_of(self.evaluator, place.theta, one))[dropped[group]]
        made = replace(self, samples=self.samples.at(groups)).at(place.theta, own[groups])
        changed = {name: getattr(place, name).copy() for name in ("light", "by_theta", "by_own")}
        for name, values in changed.items():
            values[groups] = getattr(made, name)
        return replace(place, own=own, **changed)

    def errors(self, place: Place) -> Light:
        """Return data less expectation in units of sigma, 0 for unused samples."""
        return (self.samples.rate - place.level) * np.sqrt(self.samples.weight)

    def with_overlaps(self, theta: Float[np.ndarray, " p"]) -> DiffractionProblem:
        """Set the overlaps to those of ``theta``: they hardly change in a descent."""
        evaluator, lattice = self.evaluator, self.evaluator.lattice
        of_nodes = len(evaluator.wavelengths_nm), len(TERMS) if evaluator.interference else 0
        # They are large: none is made twice.
        found = np.empty((len(self.samples.index), *of_nodes, lattice.rows, lattice.columns // 2 + 1), np.float32)

        def make(position: int) -> None:
            found[position] = evaluator.overlaps(theta, self.samples.at(position).frame)

        in_two_threads(make, range(len(found)))
        return replace(self, samples=replace(self.samples, overlaps=found))

    def about(self, theta: Theta, own: Own, near: bool = False) -> DiffractionProblem:
        """Set interference up about these parameters; ``near`` the last ones, derivatives by overlaps stay."""
        problem = self.with_overlaps(theta)
        if not self.evaluator.interference:
            return problem
        parts = zip(problem.samples.each(), own[..., :2], strict=True)
        made = in_two_threads(lambda part: _set_up(self.evaluator, theta, *part, near), parts)
        # Overlaps are large: no copy is made of them.
        set_up = {name: np.stack([getattr(one, name) for one in made]) for name in _SET_UP}
        return replace(self, samples=replace(problem.samples, **set_up))


def stepped(theta: Float[np.ndarray, " p"], step: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
    """Return parameters after a step; spectra and powers of shapes grow by the step itself, not by its exponential.

    Lengths and openings stay positive: they at most halve, or double.
    """
    spectra, logs = softmax(theta[HEAD:].reshape(3, -1), axis=1), step[HEAD:].reshape(3, -1)
    mean = np.sum(spectra * logs, axis=1, keepdims=True)
    grown = logs - mean
    grown = np.where(grown > 0, np.log1p(np.maximum(grown, 0.0)), grown)
    moved = theta + np.concatenate([step[:HEAD], (mean + grown).ravel()])
    moved[_POSITIVE] = np.clip(moved[_POSITIVE], 0.5 * theta[_POSITIVE], 2.0 * theta[_POSITIVE])
    moved[_SHAPES] = theta[_SHAPES] + _log_change(step[_SHAPES])
    return moved


def _log_change(step: Float[np.ndarray, " shapes"]) -> Float[np.ndarray, " shapes"]:
    """Return the change of the logarithms of shapes that a step of these means for their powers v = exp(k l).

    Light is nearly linear in v. Gauss and Newton's step s of the logarithm means v (1 + k s): where a shape is too
    small to be seen, exp(k s) v would be far too much. Steps to less have the curvature that ``equations_at`` adds,
    without which they would be s / (1 + k s). No v shrinks to less than a tenth.
    """
    power = _POWERS[_SHAPES]
    more, less = power * np.maximum(step, 0.0), power * np.minimum(step, 0.0)
    part = np.maximum(1.0 + 2.0 * less, 0.0) / (1.0 + np.maximum(less, -0.5))
    return np.asarray(np.log(np.maximum(part, 0.1) + more) / power)


def _by_grown(
    by_theta: Float[np.ndarray, "positions shots n p"], change: Float[np.ndarray, " shapes"]
) -> Float[np.ndarray, "positions shots n p"]:
    """Return derivatives after changes of the shapes' logarithms: those by these grow as their powers do."""
    if not change.any():
        return by_theta
    grown = by_theta.copy()
    grown[..., _SHAPES] *= np.exp(_POWERS[_SHAPES] * change)
    return grown


def _moved_own(own: Float[np.ndarray, "*k l"], step: Float[np.ndarray, "*k l"]) -> Float[np.ndarray, "*k l"]:
    """Return own parameters after a step; places of LEDs move by half a pixel at most."""
    return own + np.concatenate([np.clip(step[..., :2], -0.5, 0.5), step[..., 2:]], axis=-1)


def _huber_weight(residual: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return weights of squared residuals in a step, those of Huber's loss."""
    return np.asarray(weight * np.minimum(1.0, HUBER.sigma / np.maximum(np.abs(residual) * np.sqrt(weight), 1e-12)))


def kernel_of(evaluator: Evaluator, theta: Float[np.ndarray, " p"], one: Samples) -> Kernel:
    """Return the kernel at one position."""
    return Kernel(evaluator.lattice, np.asarray(evaluator.kernel(theta, one.frame, one.disc_px, one.overlaps)))


def _slopes(evaluator: Evaluator, theta: Theta, one: Samples, own: Own) -> Float[np.ndarray, "shots n p"]:
    """Return derivatives of the light of one position's samples by the shared parameters."""
    spectra = softmax(theta[HEAD:].reshape(3, -1), axis=1)
    # Single precision takes less time, and its errors are a millionth of a derivative.
    with jax.enable_x64(False):
        by_channel = evaluator.jacobian(theta, one.frame, one.disc_px, one.overlaps)
        coefficients, chain = (np.asarray(part) for part in by_channel)
    made = one.sampled(Kernel(evaluator.lattice, coefficients), own[:, :2])
    nodes, by_factor = np.split(made, [spectra.shape[1]], axis=-1)
    of_colour = one.colour @ spectra
    unit = np.einsum("snj,snj->sn", nodes, of_colour)
    of_own = by_factor.reshape(*unit.shape, -1, 3) * one.colour[:, :, None]
    by_head = of_own.reshape(*unit.shape, -1) @ chain.reshape(-1, chain.shape[-1])
    by_head[..., _IN_OVERLAPS] += one.by_overlaps
    by_logs = one.colour[..., None] * (of_colour * (nodes - unit[..., None]))[..., None, :]
    return np.concatenate([by_head, by_logs.reshape(*unit.shape, -1)], axis=-1) * one.flux(own)[..., None]


def _set_up(
    evaluator: Evaluator, theta: Theta, one: Samples, offset_px: Float[np.ndarray, "shots 2"], near: bool
) -> Samples:
    """Return one position's samples with interference set up about these parameters; see ``Samples``."""

    def light(overlaps: np.ndarray) -> Light:
        return one.unit_light(kernel_of(evaluator, theta, replace(one, overlaps=overlaps)), offset_px)

    here = light(one.overlaps)
    # The pupil's footprint moves with a shot's own place.
    slope = one.frame.direction[:2] / one.frame.direction[2]
    tangent = (np.eye(2) + np.outer(slope, slope)) / one.frame.direction[2]
    along = theta[FOOTPRINT][2] * (one.begun_px + offset_px) @ (tangent @ one.frame.jacobian).T
    correction = np.zeros_like(here)
    for shot, change in enumerate(along):
        more = np.asarray(evaluator.moved(theta, one.frame, one.disc_px, one.overlaps, change))
        correction[shot] = one.unit_light(Kernel(evaluator.lattice, more), offset_px)[shot]
    one = replace(one, overlaps_at=theta[_IN_OVERLAPS], correction=correction)
    if near:
        return one
    # Overlaps are in single precision: steps of this length (mm) keep their difference precise. Steps ten times as
    # long change derivatives by some per cent.
    by_overlaps = []
    for i, step in zip(_IN_OVERLAPS, (2e-4, 1e-3), strict=True):
        moved = np.asarray(evaluator.overlaps(theta + step * np.eye(theta.size)[i], one.frame))
        by_overlaps.append((light(moved) - here) / step)
    return replace(one, by_overlaps=np.stack(by_overlaps, axis=-1))


def start_own(one: Samples, kernel: Kernel) -> Own:
    """Start own parameters of one position's shots: the best of a grid of places, light and background linear in it.

    A centroid is not accurate enough. Neighbouring diffraction orders are half as bright as the middle one, and the
    mosaic samples each colour unevenly: it can be off by a pixel, and a descent then ends on a neighbouring order.
    """
    moves = np.stack(np.meshgrid(*2 * (np.linspace(-1.25, 1.25, 11),)), axis=-1).reshape(-1, 1, 2)
    moves = np.repeat(moves, len(one.rate), axis=1)
    # Places are compared on the samples about the brightest spot; 117 of them are enough.
    near = one.nearest(117)
    offset = moves[_linear(near, near.unit_light(kernel, moves))[1].argmin(axis=0), 0]
    light, _ = _linear(one, one.unit_light(kernel, offset)[None])
    return np.concatenate([offset, light[0]], axis=-1)


def _linear(
    one: Samples, units: Float[np.ndarray, "moves shots n"]
) -> tuple[Float[np.ndarray, "moves shots 4"], Float[np.ndarray, "moves shots"]]:
    """Fit light per colour and background of the shots for each of several expectations; return them and the cost."""
    seen = one.weight > 0
    # Far from the solution, the model error is a tenth of the signal or more.
    variance = 1.0 / np.where(seen, one.weight, 1.0) + (0.1 * np.maximum(one.rate, 0.0)) ** 2
    root = np.where(seen, 1.0 / np.sqrt(variance), 0.0)
    design = np.concatenate([units[..., None] * one.colour, np.ones((*units.shape, 1))], axis=-1) * root[..., None]
    data, across = (one.rate * root)[..., None], np.swapaxes(design, -1, -2)
    solution = scaled_inverse(across @ design) @ (across @ data)
    # Without the bound a place where nothing is expected would fit a dark neighbourhood best.
    left = np.minimum(np.abs(data - design @ solution), 10.0)
    return solution[..., 0], (left[..., 0] ** 2).sum(axis=-1)


def _own_alone(one: Samples, kernel: Kernel) -> Own:
    """Fit own parameters of one position's shots to a kernel."""
    own = start_own(one, kernel)
    for _ in range(3):
        unit = one.unit_light(kernel, own[:, :2])
        by_own = one.own_slopes(own, kernel, unit)
        residual = one.rate - unit * one.flux(own) - own[:, 5:]
        across = np.swapaxes(by_own * _huber_weight(residual, one.weight)[..., None], 1, 2)
        step = scaled_inverse(across @ by_own, 1e-14) @ (across @ residual[..., None])
        own = _moved_own(own, step[..., 0])
    return own


def explain(
    evaluator: Evaluator, theta: Float[np.ndarray, " p"], shots: Shots, geometry: Geometry, model_error: float
) -> tuple[Sources, Crops]:
    """Apply diffraction to whole crops: return place and light of the LEDs, and the samples' light per unit."""
    evaluator = replace(evaluator, lattice=fit_lattice(shots.half))
    samples = gather(shots, geometry, np.ones(shots.rate.shape, dtype=bool)).weighed(model_error)
    found, explained = np.zeros((shots.count, OWN)), np.zeros(shots.rate.shape)

    def fitted(one: Samples) -> tuple[Own, Light]:
        one = replace(one, overlaps=np.asarray(evaluator.overlaps(theta, one.frame)))
        kernel = kernel_of(evaluator, theta, one)
        own = _own_alone(one, kernel)
        return own, one.unit_light(kernel, own[:, :2])

    for index, (own, unit) in zip(samples.index, in_two_threads(fitted, samples.each()), strict=True):
        real = index >= 0
        found[index[real]], explained[index[real]] = own[real], unit[real].reshape(-1, *shots.rate.shape[1:])
    sources = Sources(shots.centre_px + found[:, :2], found[:, 2:5], found[:, 5])
    return sources.with_light_of_peak(shots, explained), explained
