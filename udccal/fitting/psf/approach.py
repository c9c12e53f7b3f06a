"""First descents of a fit of diffraction: from the prior's mean to near the minimum.

Where openings do not fit, an opaque bar through them is looked for, such as a wire of the panel. A bar of a few
hundredths of a period changes kernels by ten per cent and more. Its place has several minima: descents begin at some
places on each axis.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from typing import Final, final

import numpy as np

from udccal.fitting.engine.gaussian import Prior
from udccal.fitting.engine.least_squares import LOG, Blocks, Solution, SolverRules, minimise
from udccal.fitting.engine.orders import Attempt, Choice, bic, choose
from udccal.fitting.psf.data import PsfRules
from udccal.fitting.psf.kernel import BAR_PLACE, BAR_WIDTH, FOOTPRINT, OPENINGS, PUPIL, Own, Samples, Theta
from udccal.fitting.psf.problem import DiffractionProblem, Place, kernel_of, start_own
from udccal.numerics import in_two_threads

_AXES: Final = ("columns", "rows")
# Parameters that a bar has.
_OF_BAR: Final = 2
# Of the prior: a chance that drawn rigs do not have.
_FAR_SIGMA = 4.0


@final
@dataclass(frozen=True)
class Approach:
    """A problem with weights by the data, and where a first descent ended."""

    problem: DiffractionProblem
    end: Solution[Place, Blocks]

    def attempt(self, name: str) -> Attempt[Approach]:
        """As an order that BIC compares to others."""
        unknowns = self.problem.unknowns + _OF_BAR * self.problem.evaluator.barred
        criterion = bic(self.end.equations.cost, float(unknowns), self.problem.used)
        return Attempt(name, unknowns, criterion, self)


def approach(problem: DiffractionProblem, rules: PsfRules) -> Choice[Approach]:
    """Return the approach with openings as they are, or with a bar on the axis that explains the data best.

    A bar is looked for where openings without one do not fit; BIC compares the two.
    """
    problem = replace(problem, samples=problem.samples.weighed(rules.first_model_error))
    plain = Approach(problem, _from_mean(problem, rules))
    attempts = [plain.attempt("openings without a bar (BIC)")]
    if plain.end.equations.cost > rules.barred_from * problem.used:
        axis, found = _with_bar(plain, rules)
        if found.end.place.theta[BAR_WIDTH][axis] > rules.least_bar:
            attempts.append(found.attempt(f"a bar through openings of {_AXES[axis]} (BIC)"))
    return choose(attempts)


def second_approach(problem: DiffractionProblem, theta: Theta, rules: PsfRules) -> tuple[Solution[Place, Blocks], ...]:
    """Begin again where a minimum has left the prior: it may be beside the lowest one.

    The footprint's place on the rows is periodic in the data, and takes the part of a pupil that is too wide; a model
    error as large as the residuals there lets the place fit. The second descent has the footprint's place held, which
    leaves the residuals to the pupil, and no model error. The minima tell which of the two is the lower.
    """
    prior = problem.prior
    far = np.abs(theta - prior.mean) > _FAR_SIGMA * prior.sigma
    if not far[PUPIL] and not far[FOOTPRINT].any():
        return ()
    held = np.zeros(prior.mean.size, dtype=bool)
    held[FOOTPRINT] = True
    return (_from_mean(replace(problem, samples=problem.samples.weighed(0.0), held=held), rules),)


def _from_mean(problem: DiffractionProblem, rules: PsfRules) -> Solution[Place, Blocks]:
    """Go from the prior's mean until a step gains a thousandth of the cost."""
    prior = problem.prior

    def start(one: Samples) -> Own:
        return start_own(one, kernel_of(problem.evaluator, prior.mean, one))

    own = np.stack(in_two_threads(start, problem.samples.each()))
    return minimise(problem, problem.at(prior.mean, own), solver_rules(1e-3 * problem.used, rules.iterations))


def _with_bar(plain: Approach, rules: PsfRules) -> tuple[int, Approach]:
    """Begin at every place on both axes for a few steps with some positions, and go on from the best with all."""
    problem = replace(plain.problem, evaluator=replace(plain.problem.evaluator, barred=True))
    own, tried = plain.end.place.own, []
    # Positions spread over the field; the first steps need no more.
    spread = np.unique(np.linspace(0, len(own) - 1, rules.bar_positions).round().astype(int))
    few, enough = replace(problem, samples=problem.samples.at(spread)), 1e-3 * problem.used
    for axis, part in product(range(2), rules.bar_places):
        prior = barred_prior(problem.prior, axis, part * float(problem.prior.mean[OPENINGS][axis]), rules)
        begun = replace(few, prior=prior)
        end = minimise(begun, begun.at(prior.mean, own[spread]), solver_rules(enough, rules.bar_steps))
        tried.append((end.equations.cost, axis, prior, end.place.theta))
        LOG.debug("psf: a bar from %.2f of openings of %s, cost %.6g", part, _AXES[axis], end.equations.cost)
    _, axis, prior, theta = min(tried, key=lambda one: one[0])
    problem = replace(problem, prior=prior)
    solution = minimise(problem, problem.at(theta, own), solver_rules(enough, rules.iterations))
    return axis, Approach(problem, solution)


def barred_prior(prior: Prior, axis: int, place: float, rules: PsfRules) -> Prior:
    """Return the ``prior`` of openings without a bar, with one at ``place`` on an axis.

    The openings have the rig's whole tolerances again: the wire has measured them as if there were no bar.
    """
    mean, root = prior.mean.copy(), prior.root.copy()
    mean[BAR_WIDTH][axis], mean[BAR_PLACE][axis] = rules.bar_width, place
    for part, sigma in zip((BAR_WIDTH, BAR_PLACE), rules.bar_sigma, strict=True):
        number = part.start + axis
        root[number, number] = 1.0 / sigma
    root[OPENINGS] *= rules.wire_tolerance
    return Prior(mean, root)


def solver_rules(enough: float, iterations: int, most_damping: float = 1e6) -> SolverRules:
    """Return the rules of a descent that ends where a step would gain less than ``enough``."""
    # Derivatives are sums over a lattice, whose errors predict a small gain without end.
    return SolverRules(enough, stalled_gain=0.05, iterations=iterations, first_damping=1e-2, most_damping=most_damping)
