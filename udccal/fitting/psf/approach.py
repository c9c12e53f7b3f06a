"""First descents of a fit of diffraction: from the prior's mean to near the minimum.

Where plain openings do not fit, round corners and slants are looked for, and then an opaque bar, such as a wire of the
panel. Corners of a tenth of a period and bars of a few hundredths change kernels by ten per cent and more. A bar's
place has several minima: descents begin at some places on each axis.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import product
from typing import Final, final

import numpy as np

from udccal.fitting.engine.gaussian import Prior
from udccal.fitting.engine.least_squares import LOG, Blocks, Solution, SolverRules, minimise
from udccal.fitting.engine.orders import Attempt, Choice, bic, choose
from udccal.fitting.psf.data import PsfRules
from udccal.fitting.psf.kernel import AXES, BAR_PLACE, BAR_WIDTH, CORNER, FOOTPRINT, OPENINGS, PUPIL, SLANT, Theta
from udccal.fitting.psf.problem import DiffractionProblem, Place, kernel_of, start_own
from udccal.fitting.psf.samples import Own, Samples
from udccal.numerics import in_two_threads

# Parameters that a bar has, and that corners and slants have.
_OF_BAR: Final = 2
_OF_SHAPE: Final = 3
# Of the pupil's footprint.
_WIDTH_AND_PLACE: Final = np.array([PUPIL, *range(FOOTPRINT.start, FOOTPRINT.stop)])
# Of the prior: a chance that drawn rigs do not have.
_FAR_SIGMA = 4.0


@final
@dataclass(frozen=True)
class Approach:
    """A problem with weights by the data, and where a first descent ended.

    Overlaps of the prior's mean are large. An ``attempt`` leaves them behind: what follows sets them up about the end.
    """

    problem: DiffractionProblem
    end: Solution[Place, Blocks]

    @property
    def cost_per_sample(self) -> float:
        """Cost per sample."""
        return self.end.equations.cost / self.problem.used

    def attempt(self) -> Attempt[Approach]:
        """As an order that BIC compares to others."""
        prior = self.problem.prior
        bars = [f"a bar through openings of {AXES[axis]}" for axis in np.flatnonzero(prior.mean[BAR_WIDTH])]
        corners = ["round corners and slants"] * self.problem.evaluator.shaped
        unknowns = self.problem.unknowns + _OF_SHAPE * len(corners) + _OF_BAR * len(bars)
        criterion = bic(self.end.equations.cost, float(unknowns), self.problem.used)
        left = replace(self, problem=replace(self.problem, samples=self.problem.samples.without_overlaps()))
        return Attempt(f"{', '.join([*corners, *bars]) or 'plain openings'} (BIC)", unknowns, criterion, left)


def approach(problem: DiffractionProblem, rules: PsfRules) -> Choice[Approach]:
    """Return the likeliest approach by BIC: plain openings, round corners and slants, or a bar in addition.

    Each is looked for where what came before it does not fit.
    """
    problem = replace(problem, samples=problem.samples.weighed(rules.first_model_error))
    plain = _from_mean(problem, rules)
    attempts, own = [plain.attempt()], plain.end.place.own
    shaped = replace(problem, evaluator=replace(problem.evaluator, shaped=True))
    if plain.cost_per_sample > rules.shaped_from:
        prior = shaped_prior(problem.prior, rules)
        attempts.append(_descended(replace(shaped, prior=prior), prior.mean, own, rules).attempt())
    if (best := choose(attempts).best.fit).cost_per_sample > rules.shaped_from:
        barred = _with_bar(shaped, best, own, rules)
        if barred is not None and barred.end.place.theta[BAR_WIDTH].max() > rules.least_bar:
            attempts.append(barred.attempt())
    return choose(attempts)


def far_from_prior(theta: Theta, prior: Prior) -> bool:
    """Return whether the footprint's width or place have left the prior: a minimum may be beside the lowest one."""
    return bool((np.abs(theta - prior.mean) > _FAR_SIGMA * prior.sigma)[_WIDTH_AND_PLACE].any())


def with_place_held(problem: DiffractionProblem, theta: Theta) -> tuple[DiffractionProblem, Theta]:
    """Return a problem that holds the footprint's place, and parameters with the prior's footprint.

    The footprint's place on the rows is periodic in the data, and takes the part of a pupil of another width. Held, it
    leaves the residuals to the pupil.
    """
    begun, held = theta.copy(), np.zeros(theta.size, dtype=bool)
    begun[_WIDTH_AND_PLACE] = problem.prior.mean[_WIDTH_AND_PLACE]
    held[FOOTPRINT] = True
    return replace(problem, held=held), begun


def approach_without_error(problem: DiffractionProblem, rules: PsfRules) -> Solution[Place, Blocks]:
    """Descend from the prior's mean with the footprint's place held, and without a model error.

    Where the wire's footprint is of a wrong width, a model error as large as the residuals there lets the place fit.
    """
    mean = problem.prior.mean
    held, _ = with_place_held(replace(problem, samples=problem.samples.weighed(0.0)), mean)
    return _from_mean(held.with_overlaps(mean), rules).end


def _from_mean(problem: DiffractionProblem, rules: PsfRules) -> Approach:
    """Return the descent from the prior's mean."""
    mean = problem.prior.mean

    def start(one: Samples) -> Own:
        return start_own(one, kernel_of(problem.evaluator, mean, one))

    return _descended(problem, mean, np.stack(in_two_threads(start, problem.samples.each())), rules)


def _descended(problem: DiffractionProblem, theta: Theta, own: Own, rules: PsfRules) -> Approach:
    """Go from a place until a step gains a thousandth of the samples' number."""
    end = minimise(problem, problem.at(theta, own), _first_rules(1e-3 * problem.used, rules.iterations))
    return Approach(problem, end)


def _with_bar(problem: DiffractionProblem, without: Approach, own: Own, rules: PsfRules) -> Approach | None:
    """Begin at every place on both axes with some positions, and go on from the best with all.

    A descent may begin slowly and end lowest. So after a few steps, several of the best go on to their ends. Where none
    of them fits better than what is found ``without`` a bar, there is none.
    """
    # Positions spread over the field; the first steps need no more.
    spread = np.unique(np.linspace(0, len(own) - 1, rules.bar_positions).round().astype(int))
    few, enough = replace(problem, samples=problem.samples.at(spread)), 1e-3 * problem.used
    begun = []
    for axis, part in product(range(2), rules.bar_places):
        prior = shaped_prior(problem.prior, rules, (axis, part * float(problem.prior.mean[OPENINGS][axis])))
        barred = replace(few, prior=prior)
        end = minimise(barred, barred.at(prior.mean, own[spread]), _first_rules(enough, rules.bar_steps))
        begun.append(Approach(barred, end))
        LOG.debug("psf: a bar from %.2f of openings of %s, cost %.6g", part, AXES[axis], end.equations.cost)
    begun.sort(key=lambda one: one.end.equations.cost - one.end.gain)
    rest = _first_rules(enough, rules.iterations)
    ends = [replace(one, end=minimise(one.problem, one.end.place, rest)) for one in begun[: rules.bar_ends]]
    best = min(ends, key=lambda one: one.end.equations.cost)
    costs = [position.cost for position in without.problem.by_position(without.end.place)]
    of_data = best.end.equations.cost - best.problem.prior.cost(best.end.place.theta)
    if of_data >= sum(costs[position] for position in spread):
        return None
    return _descended(replace(problem, prior=best.problem.prior), best.end.place.theta, own, rules)


def shaped_prior(prior: Prior, rules: PsfRules, bar: tuple[int, float] | None = None) -> Prior:
    """Return a ``prior`` of plain openings with round corners and slants, and perhaps a bar at a place on an axis.

    The openings have the rig's whole tolerances again: the wire has measured them as if they were plain.
    """
    mean, root = prior.mean.copy(), prior.root.copy()
    medians = {CORNER: rules.corner, SLANT.start: rules.slant, SLANT.start + 1: rules.slant}
    shape = [(number, math.log(median), rules.shape_log_sigma) for number, median in medians.items()]
    if bar is not None:
        axis, place = bar
        shape.append((BAR_WIDTH.start + axis, rules.bar_width, rules.bar_sigma[0]))
        shape.append((BAR_PLACE.start + axis, place, rules.bar_sigma[1]))
    for number, value, sigma in shape:
        mean[number], root[number, number] = value, 1.0 / sigma
    root[OPENINGS] *= rules.wire_tolerance
    return Prior(mean, root)


def solver_rules(enough: float, iterations: int, most_damping: float = 1e6) -> SolverRules:
    """Return the rules of a descent that ends where a step would gain less than ``enough``."""
    # Derivatives are sums over a lattice, whose errors predict a small gain without end.
    return SolverRules(enough, stalled_gain=0.05, iterations=iterations, first_damping=1e-2, most_damping=most_damping)


def _first_rules(enough: float, iterations: int) -> SolverRules:
    """Return the same for a first descent, which also ends where a step has gained less than ``enough``.

    Where the model does not fit, the derivatives promise a hundred times what steps gain, for as long as they go on.
    """
    return replace(solver_rules(enough, iterations), stalled_gain=enough, small_gain=math.inf)
