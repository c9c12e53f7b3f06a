"""What residuals of the backscatter fit show besides noise: patterns, parts of the sensor that disagree, brightness."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float, Int

from udccal.fitting.backscatter.parameters import Vector
from udccal.fitting.backscatter.solve import Found
from udccal.fitting.engine.misfit import NO_TEST, MisfitTest, chi2_test, excess_sigma, f_tail, group_means_test, sharper


def residual_pattern(found: Found) -> MisfitTest:
    """Test whether residuals of a shot and colour have the same sign over parts of the sensor or all of it."""
    best, used, cells = found.fitted.best, found.fitted.used, _cells(found)[0]
    groups = np.arange(used[..., 0].size).reshape(*used.shape[:2], 1) * (cells.max() + 1)
    scale = max(best.chi2 / found.dof, 1.0) * found.dof / max(used.sum(), 1)
    tests = (
        group_means_test(best.z.ravel(), (groups + parts).ravel(), used.ravel(), scale) for parts in (cells, 0 * cells)
    )
    return sharper(*tests)


def _cells(found: Found) -> tuple[Int[np.ndarray, " n"], ...]:
    """Return the part of the sensor in which each position lies: its cell, its band of rows and of columns."""
    places, across = found.places, found.problem.rules.cells
    low, high = places.min(axis=0), places.max(axis=0)
    column, row = np.minimum((places - low) / np.maximum(high - low, 1e-9) * across, across - 1).astype(int).T
    return row * across + column, row, column


@final
@dataclass(frozen=True)
class Brightness:
    """Relative scatter of the shots' brightness, 0 where chance explains it.

    ``cov`` is what it adds to the covariance of the solver's parameters, ``errors`` are whitened errors without it.
    """

    sigma: float
    test: MisfitTest
    cov: Float[np.ndarray, "18 18"]
    errors: Float[np.ndarray, " m"]


def brightness(found: Found) -> Brightness:
    """Tell whether the panel was brighter in some shots than in others, each by a part of its light.

    Parameters follow most of that: what residuals still show of it is compared with what they would show. The shots
    are few, so that the scatter is known roughly: errors over it follow Student's t, whose variance is larger.
    """
    fitted, solved, free = found.fitted, found.fitted.found, found.fitted.order.free
    errors, jacobian = found.problem.errors_at(fitted.best.weight)(solved.x)
    each, cov = np.arange(len(fitted.ratio) - 1), np.zeros_like(solved.cov)
    moves = np.zeros((len(each), *fitted.ratio.shape))
    moves[each, each] = -fitted.ratio[:-1]
    brighter = fitted.best.jacobian(moves).reshape(len(each), -1).T
    shifts = -solved.cov[:, free] @ jacobian[:, free].T @ brighter
    # What is left in the residuals, along directions that are independent of each other.
    left = brighter + jacobian[:, free] @ shifts[free]
    size, ways = np.linalg.eigh(brighter.T @ left)
    ways, size = ways[:, size > 1e-6 * size.max()], size[size > 1e-6 * size.max()]
    amount, dof = ways.T @ (brighter.T @ errors) / size, len(size)
    rest = errors - left @ (ways @ amount)
    # Brightness is common to the colours: a kernel that is wrong leaves as much by colour as it seems to explain.
    by_colour = brighter.reshape(*fitted.ratio.shape, -1)
    along = np.einsum("scn,scnk->ck", rest.reshape(fitted.ratio.shape), by_colour) ** 2
    along /= np.maximum((by_colour**2).sum(axis=(0, 2)), 1e-300)
    scale = max(fitted.best.chi2 / found.dof, float(along.sum()) / max(along.size - dof, 1), 1.0)
    statistic = float(np.sum(amount**2 * size)) / scale
    test = MisfitTest(statistic / max(dof, 1), f_tail(statistic / max(dof, 1), dof, along.size - dof))
    sigma = excess_sigma(amount**2, scale / size, np.ones(dof), float(dof)) if dof > 2 and test.found else 0.0
    # A wrong kernel's errors are larger bin by bin than what a picture's bins have in common.
    if sigma <= found.problem.rules.brightness * found.model_error:
        return Brightness(0.0, test, cov, errors)
    cov = dof / (dof - 2) * sigma**2 * shifts @ shifts.T
    return Brightness(sigma, test, cov, rest)


def disagreement(found: Found, errors: Float[np.ndarray, " m"]) -> Vector:
    """Factors of the parameters' variances, above 1 where parts of the sensor ask for different values by ``errors``.

    A kernel that is wrong by an amount that changes slowly over the field hardly shows in residuals, which have the
    signs of the pictures' edges. But it moves a parameter by different amounts in different places, and then by more
    than independent residuals do. Each part moves the parameters by its score (``clustered_cov``). Where chance is no
    explanation for the scatter of any parameter, the model is refuted, and the scatter of every parameter is the
    measure of its sigma. So few parts tell it roughly: errors over it follow Student's t, whose variance is larger.
    """
    solved, free, shape = found.fitted.found, found.fitted.order.free, found.fitted.ratio.shape
    jacobian = found.problem.errors_at(found.fitted.best.weight)(solved.x)[1]
    shifts, factors, tests = (jacobian @ solved.cov)[:, free], np.ones(len(free)), [NO_TEST]
    dof = found.problem.rules.cells**2 - 1
    for parts in _cells(found):
        member = 1.0 * (np.broadcast_to(parts, shape).ravel() == np.unique(parts)[:, None])
        square, expected = (member @ (shifts * errors[:, None])) ** 2, np.maximum(member @ shifts**2, 1e-300)
        tests += [chi2_test(float(one), len(member) - 1.0) for one in (square / expected).sum(axis=0)]
        wider = dof / (dof - 2) * square.sum(axis=0) / expected.sum(axis=0)
        factors[free] = np.maximum(factors[free], wider)
    return factors if sharper(*tests).found else np.ones(len(free))
