"""Light that the model of the panel does not have, as the residuals of a fit tell it beside all parameters.

Light that leaks in, or a panel whose black glows, is in every shot but the one with the panel off. Gamma would follow
it: dark places of pictures are brighter. A panel that limits its power shows white dimmer than the pictures. Panels
that get the limited range of video, or that have a curve of sRGB, a knee or a lifted black, follow no power of codes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float

from udccal.fitting.backscatter.data import Profile
from udccal.fitting.backscatter.model import Moves, Shares, ratios_of
from udccal.fitting.backscatter.parameters import Cov, linear_of
from udccal.fitting.backscatter.solve import Fitted, Problem
from udccal.fitting.engine.misfit import MisfitTest, f_test

WHITE, DARK = 0, -1
# Codes at which the light is free; it is 0 at code 0 and 1 at 255.
_CODES = np.array([16, 40, 72, 112, 160, 208])
# A change of gamma is one way to change the curve, and shows 0.00003 to 0.026 times as much beside gamma as others do.
_BESIDE_GAMMA = 0.03


@final
@dataclass(frozen=True)
class Beside:
    """Changes that no parameter describes, while the parameters follow.

    Attributes:
        whole: whitened errors by each change.
        shifts: of the solver's parameters by each.
        left: errors that they leave of it.
        ways: combinations of changes, by column, whose errors are independent of each other.
        size: sum of the squares of each way's errors.
    """

    whole: Float[np.ndarray, "m k"]
    shifts: Float[np.ndarray, "18 k"]
    left: Float[np.ndarray, "m k"]
    ways: Float[np.ndarray, "k rank"]
    size: Float[np.ndarray, " rank"]

    @classmethod
    def of(cls, fitted: Fitted, jacobian: Float[np.ndarray, "m 18"], of_ratio: Moves, least: float = 1e-6) -> Beside:
        """From changes of the ratios, and the Jacobian of a fit's errors.

        Combinations that the parameters can follow are left out: ``least`` of the largest sum of squares, and less.
        """
        free = fitted.order.free
        whole = fitted.best.jacobian(of_ratio).reshape(len(of_ratio), -1).T
        shifts = -fitted.found.cov[:, free] @ jacobian[:, free].T @ whole
        left = whole + jacobian[:, free] @ shifts[free]
        size, ways = np.linalg.eigh(whole.T @ left)
        kept = size > least * size.max()
        return cls(whole, shifts, left, ways[:, kept], size[kept])

    def amounts(self, errors: Float[np.ndarray, " m"]) -> Float[np.ndarray, " rank"]:
        """Return the amount of each way that errors ask for; they vanish where a change's own are their opposite."""
        return -self.ways.T @ (self.whole.T @ errors) / self.size

    def test(self, problem: Problem, fitted: Fitted, errors: Float[np.ndarray, " m"]) -> MisfitTest:
        """Test whether the changes explain more of the errors than chance; residuals of a wrong model are the scale."""
        explained, dof = float(np.sum(self.amounts(errors) ** 2 * self.size)), fitted.dof(problem.prior)
        return f_test(explained / max(fitted.best.chi2 / dof, 1.0), len(self.size), dof)


def unlike_test(
    problem: Problem,
    fitted: Fitted,
    errors: Float[np.ndarray, " m"],
    jacobian: Float[np.ndarray, "m 18"],
    shot: int,
) -> MisfitTest:
    """Test whether white or dark (``shot``) has other light than the rest, by one share of white for each colour.

    The parameters follow such a light; the test counts what they leave in the residuals. A panel whose light is no
    power of its codes leaves much of the same. Only a fit without the shot tells which it is.
    """
    more = np.zeros((3, *fitted.ratio.shape))
    more[np.arange(3), shot, np.arange(3)] = 1.0
    return Beside.of(fitted, jacobian, more).test(problem, fitted, errors)


def light_besides(problem: Problem, best: Profile) -> Float[np.ndarray, "3"]:
    """Return the light that is in the other shots but not in the dark frame, by colour, as a share of white."""
    return np.asarray((best.dark - problem.seen.rate[DARK]).sum(axis=1) / np.maximum(best.mask.sum(axis=1), 1e-12))


def brightness_of_white(problem: Problem, best: Profile) -> float:
    """Return the light of white over that which the pictures predict in a fit ``best`` without it."""
    seen, known = problem.seen, best.information
    white = seen.rate[WHITE] - seen.exposure_s[DARK] / seen.exposure_s[WHITE] * best.dark
    return float((known * best.mask * white).sum() / np.maximum((known * best.mask**2).sum(), 1e-12))


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
    def of(
        cls, problem: Problem, fitted: Fitted, errors: Float[np.ndarray, " m"], jacobian: Float[np.ndarray, "m 18"]
    ) -> PanelCurve:
        """Test a fit's whitened errors: the light is freed at some codes, and linear between them."""
        beside = Beside.of(fitted, jacobian, _curve_moves(problem, fitted), _BESIDE_GAMMA)
        test = beside.test(problem, fitted, errors)
        if not test.found:
            return cls(test, 0, 0.0, 0.0, np.zeros_like(fitted.found.cov), errors)
        by_way = beside.ways * beside.amounts(errors)
        off, shifts = by_way.sum(axis=1), beside.shifts @ by_way
        most = int(np.abs(off).argmax())
        size = float(off[most]), float(np.sqrt(np.mean(off**2)))
        # Shifts that cancel here may not do so for other pictures.
        return cls(test, int(_CODES[most]), *size, shifts @ shifts.T, errors + beside.left @ off)


def _curve_moves(problem: Problem, fitted: Fitted) -> Moves:
    """Return the derivatives of the ratios by the light at each of some codes, as shares of that at code 255."""
    theta, knots = linear_of(fitted.found.x), np.concatenate([[0], _CODES, [255]])
    shares = Shares.of(problem.template, theta, problem.rays)
    light = problem.shown.light(float(theta[0]))[0]
    # White stays the same, so that ratios are linear in all other codes' light.
    more = (np.interp(np.arange(256), knots, one)[problem.shown.values] for one in np.eye(len(knots))[1:-1])
    return np.stack([ratios_of(theta, shares, problem.shown, light + one) - fitted.ratio for one in more])
