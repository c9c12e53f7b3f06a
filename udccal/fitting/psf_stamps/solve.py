"""One psf field of given orders: fields, places, light and priors together, by Gauss and Newton's method.

Every round takes a step towards the likeliest state and sets the priors' precisions anew.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from udccal.fitting.engine.iteration_log import LOG
from udccal.fitting.psf_stamps.field import Seen
from udccal.fitting.psf_stamps.likelihood import Weighted, expectation, look
from udccal.fitting.psf_stamps.log_prior import border_prior, log_prior, quadratic, with_prior
from udccal.fitting.psf_stamps.normal import Border, borders, normal_equations
from udccal.fitting.psf_stamps.posterior import Eliminated, Posterior, eliminate, joined
from udccal.fitting.psf_stamps.retune import retuned
from udccal.fitting.psf_stamps.state import Scene, State, shifted

_HALVINGS = 6
# Converged when the next step would gain less than this in log likelihood, and the evidence changes less than that.
_GAIN, _EVIDENCE = 0.3, 2.0


@dataclass(frozen=True)
class Solved:
    """A state, the posterior about it, and how likely the orders are."""

    state: State
    posterior: Posterior
    evidence: float
    log_likelihood: float
    converged: bool
    rounds: int


def improve(scene: Scene, state: State, rounds: int, before: float = -np.inf, floor: float = -np.inf) -> Solved:
    """Rounds of steps and of the priors' precisions, until neither changes or there were so many.

    Args:
        scene: the samples.
        state: where to start.
        rounds: at most.
        before: the evidence with which ``state`` was left, where it comes from such rounds.
        floor: what stays below, even if the next step gained as much as this one, is left at once.
    """
    number, seen = 0, look(scene, state)
    while True:
        number += 1
        # The same draws in every round, so that rounds come to an end.
        solved, seen = step(scene, state, seen, np.random.default_rng(0))
        gain = solved.posterior.gain
        LOG.debug("psf field: round %d, evidence %.2f, gain %.3g", number, solved.evidence, gain)
        done = gain < _GAIN and abs(solved.evidence - before) < _EVIDENCE
        if done or number >= rounds or solved.evidence + gain < floor:
            return replace(solved, converged=done, rounds=number)
        state, before = solved.state, solved.evidence
        del solved  # its factors are the largest arrays of a fit: not two of them at a time


def step(
    scene: Scene, state: State, seen: tuple[Seen, ...], rng: np.random.Generator
) -> tuple[Solved, tuple[Seen, ...]]:
    """One step from a state whose fields bring ``seen``; and what they bring after it."""
    both = [expectation(scene, state, plane, own) for plane, own in enumerate(seen)]
    weighted, likelihood = tuple(w for w, _ in both), float(sum(part.sum() for _, part in both))
    parts = borders(state.fields, scene.unit)
    colours = tuple(_eliminated(scene, state, plane, weighted[plane], part) for plane, part in enumerate(parts))
    size = np.zeros(parts[0].size)
    for colour in colours:
        size[colour.index] += colour.border.diagonal()
    posterior = joined(colours, *border_prior(state, size))
    evidence = likelihood + log_prior(state) - 0.5 * posterior.log_det + posterior.gain
    moved, after = _moved(scene, state, posterior, weighted, seen)
    return Solved(retuned(moved, posterior, rng), posterior, evidence, likelihood, False, 1), after


def _eliminated(scene: Scene, state: State, plane: int, seen: Weighted, border: Border) -> Eliminated:
    """A function of its own, so that one colour's equations are gone before the next one's are made."""
    field = state.fields[plane]
    normal = normal_equations(field, scene.unit, seen, border.matrix)
    return eliminate(with_prior(normal, field, state.envelopes[plane], state.precisions[plane]), border)


def _moved(
    scene: Scene, state: State, posterior: Posterior, weighted: tuple[Weighted, ...], seen: tuple[Seen, ...]
) -> tuple[State, tuple[Seen, ...]]:
    """The state after the step, or after as large a part of it as makes the posterior likelier."""
    before = quadratic(state) - 0.5 * sum(float((w.weight * w.residual**2).sum()) for w in weighted)
    for halving in range(_HALVINGS):
        moved = shifted(state, posterior.nodes, posterior.border, 0.5**halving)
        after = look(scene, moved)
        if _merit(moved, after, weighted) >= before - 1e-9 * abs(before):
            return moved, after
    return state, seen


def _merit(state: State, seen: tuple[Seen, ...], like: tuple[Weighted, ...]) -> float:
    """Log posterior but for constants, with the variances that samples had before."""
    total = quadratic(state)
    for plane, (own, before) in enumerate(zip(seen, like, strict=True)):
        # Clipped samples too: their working residuals and weights are those of the step to be judged.
        left = before.residual + before.mean - state.flux_e[:, plane, None] * np.asarray(own.value)
        total -= 0.5 * float((before.weight * left**2).sum())
    return total
