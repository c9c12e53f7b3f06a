"""The state and the priors' precisions that make stamps likeliest, and the samples that no state explains."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import numpy as np
from jaxtyping import Bool, Float

from udccal.fitting.engine.gaussian import scaled_inverse
from udccal.fitting.engine.least_squares import Solution, SolverRules, Step, minimise
from udccal.fitting.engine.robust import OutlierRule, outliers
from udccal.fitting.psf_stamps.data import Scene, StampsRules
from udccal.fitting.psf_stamps.equations import factors
from udccal.fitting.psf_stamps.probability import State, expectation, expected_squares, updated
from udccal.result import Outliers

_ROUNDS_OF_PLACES, _FARTHEST_PX = 4, 0.5


@final
@dataclass(frozen=True)
class Laplace:
    """The evidence at a state by Laplace's method, and where to go from there.

    The factors that it was made with, the largest arrays of a fit, are not kept: never are there two of them.

    Attributes:
        cost: -2 log of the evidence, of an expansion about the state.
        samples: that tell something.
        mode: as changes of the state.
        tuned: logarithm of what each precision changes by.
        gain: of the log posterior up to the mode.
        root: Cholesky's, of the dense block's precision.
    """

    cost: float
    samples: int
    mode: Float[np.ndarray, " unknowns"]
    tuned: Float[np.ndarray, " groups"]
    gain: float
    root: Float[np.ndarray, "dense dense"]

    @property
    def evidence(self) -> float:
        """Its logarithm, of an expansion about the mode."""
        return self.gain - 0.5 * self.cost

    def step(self, damping: float) -> Step:
        """A part of the way: a raised diagonal would ask for the factors anew."""
        part = 1.0 / (1.0 + damping)
        return Step(part * self.mode, part * self.tuned[None], 2 * self.gain * part * (2 - part))


@final
@dataclass(frozen=True)
class Evidence:
    """The engine's problem: a step goes to the likeliest state, and sets the precisions by empirical Bayes."""

    scene: Scene
    rules: StampsRules
    name: str = "psf field of stamps"

    def equations_at(self, place: State) -> Laplace:
        """Of infinite cost where the equations are singular."""
        try:
            found = factors(self.scene, place)
        except np.linalg.LinAlgError:
            none = np.zeros(0)
            return Laplace(np.inf, 1, none, none, np.inf, np.zeros((0, 0)))
        # The same draws every time, so that a descent comes to an end.
        left = place.squares(found.draws(np.random.default_rng(0), self.rules.update_draws))
        expected = [expected_squares(*pair) for pair in zip(place.envelopes, place.precisions, strict=True)]
        before = np.concatenate([own.flat for own in place.precisions])
        after = updated(before, np.concatenate(expected), left, place.shifted(found.mode).squares())
        cost = found.log_det - 2 * (found.log_likelihood + place.log_prior)
        return Laplace(cost, self.scene.samples, found.mode, np.log(after / before), found.gain, found.root)

    def moved(self, place: State, step: Step) -> State:
        """Along all unknowns, and along the logarithms of the precisions."""
        ends = np.cumsum([len(own.flat) for own in place.precisions])[:-1]
        pairs = zip(place.precisions, np.split(np.exp(step.own[0]), ends), strict=True)
        return replace(place.shifted(step.shared), precisions=tuple(own.times(factor) for own, factor in pairs))


def improve(scene: Scene, state: State, rules: StampsRules, steps: int) -> Solution[State, Laplace]:
    """The likeliest state next to ``state``, or what so many steps lead to.

    Raises:
        numpy.linalg.LinAlgError: when the equations are singular.
    """
    # The last step tells more than the next one's promise: that knows nothing of the precisions.
    solver = SolverRules(
        least_gain=0.0,
        stalled_gain=2 * rules.evidence,
        small_gain=2 * rules.gain,
        iterations=steps,
        first_damping=0.03,
        most_damping=10.0,
    )
    problem = Evidence(scene, rules)
    found = minimise(problem, state, solver)
    if not np.isfinite(found.equations.cost):
        raise np.linalg.LinAlgError("singular at the start")
    # A last step costs nothing: its equations stand.
    last = problem.moved(found.place, found.equations.step(0.0)) if found.converged else found.place
    return replace(found, place=last)


def without_outliers(scene: Scene, state: State, rules: StampsRules) -> State:
    """The state without samples, and stars, that the model does not explain; those it does explain come back."""
    everything = replace(state, keep=tuple(np.ones_like(keep) for keep in state.keep))
    if state.out.any():
        # Left alone, a star that was out would be judged by the place and light it had when the field was coarse.
        everything = _placed(scene, everything, state.out)
    ends = np.cumsum([plane.usable.shape[1] for plane in scene.planes])[:-1]
    usable = np.concatenate([plane.usable for plane in scene.planes], axis=1)
    seen = [expectation(scene, everything, plane)[0] for plane in range(len(scene.planes))]
    z = np.concatenate([own.residual * np.sqrt(own.weight) for own in seen], axis=1)
    # Clipped samples cannot be far off in one direction.
    used = np.concatenate([(own.weight > 0) & ~plane.clipped for own, plane in zip(seen, scene.planes, strict=True)], 1)
    z = np.where(used, z, 0.0)
    keep = ~_rule(rules).off(z, used)
    kept = usable & keep
    mean = np.where(kept, z**2, 0.0).sum(axis=1) / np.maximum(kept.sum(axis=1), 1)
    lost = (usable & ~keep).sum(axis=1) / np.maximum(usable.sum(axis=1), 1)
    bad = (mean > rules.star_ratio * np.median(mean)) | (lost > rules.star_lost)
    return replace(everything, keep=tuple(np.split(keep & ~bad[:, None], ends, axis=1)))


def left_out(scene: Scene, state: State, rules: StampsRules) -> tuple[Outliers, ...]:
    """What the state leaves out: the rules, how many, and the first places."""
    places = []
    for plane, keep in zip(scene.planes, state.keep, strict=True):
        for star, sample in np.argwhere(plane.usable & ~keep & ~state.out[:, None]):
            x, y = plane.offset_px[star, sample]
            places.append(f"stamp {star}, {x:+.0f} px, {y:+.0f} px from its middle")
    rule = (
        f"stamps whose mean square is over {rules.star_ratio:g} times the median's, or that lose "
        f"{100 * rules.star_lost:.0f} % of their samples"
    )
    return _rule(rules).listed(places) + outliers(rule, (f"stamp {star}" for star in np.flatnonzero(state.out)))


def _rule(rules: StampsRules) -> OutlierRule:
    return OutlierRule("samples", rules.outlier_sigma)


def _placed(scene: Scene, state: State, stars: Bool[np.ndarray, " stars"]) -> State:
    """Some stars' places and light fitted anew, the field being as it is."""
    planes = len(scene.planes)
    for _ in range(_ROUNDS_OF_PLACES):
        matrix = np.zeros((len(stars), 2 + planes, 2 + planes))
        right = np.zeros((len(stars), 2 + planes))
        for plane in range(planes):
            seen, _ = expectation(scene, state, plane)
            own = np.array([0, 1, 2 + plane])
            slopes = seen.slopes[..., [1, 2, 0]]
            matrix[:, own[:, None], own] += np.einsum("ksi,ks,ksj->kij", slopes, seen.weight, slopes)
            right[:, own] += np.einsum("ksi,ks->ki", slopes, seen.weight * seen.residual)
        move = np.einsum("kij,kj->ki", scaled_inverse(matrix), right) * stars[:, None]
        move = np.clip(move, -_FARTHEST_PX, _FARTHEST_PX)
        state = replace(state, centre_px=state.centre_px + move[:, :2], flux_e=state.flux_e * np.exp(move[:, 2:]))
    return state
