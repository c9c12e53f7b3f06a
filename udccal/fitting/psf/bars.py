"""Search for an opaque bar through the panel's openings, such as a wire that crosses them.

A bar of a few hundredths of a period changes kernels by ten per cent and more. Its place has several minima: descents
begin at some places on each axis. None begins where openings without a bar fit.
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
from udccal.fitting.psf.kernel import BAR_PLACE, BAR_WIDTH, OPENINGS
from udccal.fitting.psf.problem import DiffractionProblem, Place

_AXES: Final = ("columns", "rows")
# Parameters that a bar has.
_OF_BAR: Final = 2


@final
@dataclass(frozen=True)
class Approach:
    """A problem, and where a first descent of it ended."""

    problem: DiffractionProblem
    end: Solution[Place, Blocks]

    @property
    def criterion(self) -> float:
        """Bayesian information criterion; all approaches have the same weights."""
        unknowns = self.problem.unknowns + _OF_BAR * self.problem.evaluator.barred
        return bic(self.end.equations.cost, float(unknowns), self.problem.used)


def find_bar(plain: Approach, solver: SolverRules, rules: PsfRules) -> Choice[Approach]:
    """Return the approach with a bar, on the axis that explains the data best, or ``plain`` where that is no better.

    Args:
        plain: openings without a bar, whose samples have weights by the data.
        solver: of the approach with a bar.
        rules: when a bar is looked for, and where.
    """
    attempts = [Attempt("openings without a bar (BIC)", plain.problem.unknowns, plain.criterion, plain)]
    if plain.end.equations.cost > rules.barred_from * plain.problem.used:
        axis, found = _with_bar(plain, solver, rules)
        unknowns = plain.problem.unknowns + _OF_BAR
        attempts.append(Attempt(f"a bar through openings of {_AXES[axis]} (BIC)", unknowns, found.criterion, found))
    return choose(attempts)


def _with_bar(plain: Approach, solver: SolverRules, rules: PsfRules) -> tuple[int, Approach]:
    """Begin at every place on both axes for a few steps with some positions, and go on from the best with all."""
    problem = replace(plain.problem, evaluator=replace(plain.problem.evaluator, barred=True))
    own, tried = plain.end.place.own, []
    # Positions spread over the field; the first steps need no more.
    spread = np.unique(np.linspace(0, len(own) - 1, rules.bar_positions).round().astype(int))
    few, steps = replace(problem, samples=problem.samples.at(spread)), replace(solver, iterations=rules.bar_steps)
    for axis, part in product(range(2), rules.bar_places):
        prior = barred_prior(problem.prior, axis, part * float(problem.prior.mean[OPENINGS][axis]), rules)
        begun = replace(few, prior=prior)
        end = minimise(begun, begun.at(prior.mean, own[spread]), steps)
        tried.append((end.equations.cost, axis, prior, end.place.theta))
        LOG.debug("psf: a bar from %.2f of openings of %s, cost %.6g", part, _AXES[axis], end.equations.cost)
    _, axis, prior, theta = min(tried, key=lambda one: one[0])
    problem = replace(problem, prior=prior)
    return axis, Approach(problem, minimise(problem, problem.at(theta, own), solver))


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
