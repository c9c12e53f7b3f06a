"""Whether the panel's light follows a power of its codes, as the model has it.

Panels that get the limited range of video, or that have a curve of sRGB, a knee or a lifted black, do not. The test
frees the light at some codes, linear between them, and looks at what the residuals say of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float

from udccal.fitting.backscatter.model import Moves, Shares, ratios_of
from udccal.fitting.backscatter.parameters import Cov, linear_of
from udccal.fitting.backscatter.solve import Fitted, Problem
from udccal.fitting.engine.misfit import MisfitTest, f_test

# Codes at which the light is free; it is 0 at code 0 and 1 at 255.
_CODES = np.array([16, 40, 72, 112, 160, 208])
# A change of gamma is one way to change the curve, and shows 0.00003 to 0.026 times as much beside gamma as others do.
_BESIDE_GAMMA = 0.03


@final
@dataclass(frozen=True)
class PanelCurve:
    """How the panel's light differs from a power of its codes.

    Attributes:
        test: of all codes together.
        code, off: where it differs most, and by how much there, as a share of the light at code 255; 0 unless found.
        rms: of the difference over the codes, which is the error to expect of a new picture.
        cov: what that adds to the covariance of the solver's parameters.
        rest: whitened errors without what it explains.
    """

    test: MisfitTest
    code: int
    off: float
    rms: float
    cov: Cov
    rest: Float[np.ndarray, " m"]

    @classmethod
    def of(cls, problem: Problem, fitted: Fitted) -> PanelCurve:
        """Test a fit's whitened errors."""
        errors, jacobian = problem.errors_at(fitted.best.weight)(fitted.found.x)
        beside = fitted.beside_parameters(jacobian, curve_moves(problem, fitted))
        found, dof = beside.explained(errors, _BESIDE_GAMMA), fitted.dof(problem.prior)
        test = f_test(found.chi2 / max(fitted.best.chi2 / dof, 1.0), found.rank, dof)
        if not test.found:
            return cls(test, 0, 0.0, 0.0, np.zeros_like(fitted.found.cov), errors)
        off, shifts = found.by_way.sum(axis=1), beside.shifts @ found.by_way
        most = int(np.abs(off).argmax())
        # Shifts that cancel here may not do so for other pictures.
        size = float(off[most]), float(np.sqrt(np.mean(off**2)))
        return cls(test, int(_CODES[most]), *size, shifts @ shifts.T, errors + beside.left @ off)


def curve_moves(problem: Problem, fitted: Fitted) -> Moves:
    """Return the derivatives of the ratios by the light at each of some codes, as shares of that at code 255."""
    theta, knots = linear_of(fitted.found.x), np.concatenate([[0], _CODES, [255]])
    shares = Shares.of(problem.template, theta, problem.rays)
    light = problem.shown.light(float(theta[0]))[0]
    # White stays the same, so that ratios are linear in all other codes' light.
    more = (np.interp(np.arange(256), knots, one)[problem.shown.values] for one in np.eye(len(knots))[1:-1])
    return np.stack([ratios_of(theta, shares, problem.shown, light + one) - fitted.ratio for one in more])
