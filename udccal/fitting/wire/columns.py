"""The place of faint columns: a part of a period on, they may fit nearly as well, and the descent may end there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from udccal.fitting.engine.least_squares import Blocks, Solution, minimise
from udccal.fitting.wire.data import Pixels
from udccal.fitting.wire.jacobian import WireProblem, expected_of
from udccal.fitting.wire.parameters import SHAPE_NAMES
from udccal.fitting.wire.rules import SOLVER
from udccal.models.wire import Wire

_SHIFTS = np.arange(8) / 8
# In periods: closer minima are one.
_APART = 1 / 32

Found = Solution[Float[np.ndarray, " n"], Blocks]


def likely_columns(
    wire: Wire, gains: Float[np.ndarray, " sites"], pixels: Pixels, column_open: float, margin: float = 0.0
) -> list[Wire]:
    """The wire with its origin along X moved by each eighth of a period, where that fits the pixels; the best is first.

    Chi-squared is at most ``margin`` above the lowest. The columns' openings are as built: a fit to few pixels may put
    faint columns half a period off, with openings wider than their period.
    """
    wire, offset = replace(wire, column_open=np.float64(column_open)), np.asarray(wire.offset_periods)
    shifted = [replace(wire, offset_periods=offset + np.array([shift, 0.0])) for shift in _SHIFTS]
    errors = (pixels.value - expected_of(one, gains, pixels) for one in shifted)
    chi2 = np.array([np.sum(error**2 * pixels.weight) for error in errors])
    return [shifted[k] for k in np.argsort(chi2, kind="stable") if chi2[k] <= chi2.min() + margin]


def best_of_columns(problem: WireProblem, here: Found, starts: list[Wire]) -> tuple[Found, Float[np.ndarray, "n n"]]:
    """The lowest of the minima that are reached from the columns' places of other wires, and the parameters' spread.

    The spread is the second moment of all minima about the lowest one, each with the weight of its likelihood.
    """
    first, names = problem.parameters.linear, list(SHAPE_NAMES)
    offset, opening = (first + names.index(name) for name in ("offset_x_periods", "column_open"))
    tried = [here]
    for start in starts:
        x = here.place.copy()
        x[offset], x[opening] = float(np.asarray(start.offset_periods)[0]), float(start.column_open)
        tried.append(minimise(problem, x, SOLVER))
    tried.sort(key=lambda one: one.equations.cost)
    best, away, weights = tried[0], [np.zeros_like(here.place)], [1.0]
    for one in tried[1:]:
        moved = one.place - best.place
        moved[offset] -= np.round(moved[offset])
        if min(abs(moved[offset] - other[offset]) for other in away) > _APART:
            away.append(moved)
            weights.append(float(np.exp(0.5 * (best.equations.cost - one.equations.cost))))
    part, off = np.array(weights) / np.sum(weights), np.array(away)
    return best, np.asarray((off.T * part) @ off)
