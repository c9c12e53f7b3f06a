"""Whether white or the dark frame contradict the pictures by light that no kernel makes.

Light that leaks in, or a panel whose black glows, is in every shot but the one with the panel off. Gamma would follow
it: dark places of pictures are brighter. A panel that limits its power shows white dimmer than the pictures.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from udccal.fitting.backscatter.data import Profile
from udccal.fitting.backscatter.solve import Fitted, Problem
from udccal.fitting.engine.misfit import MisfitTest, f_test

WHITE, DARK = 0, -1


def unlike_test(problem: Problem, fitted: Fitted, shot: int) -> MisfitTest:
    """Test whether white or dark (``shot``) has other light than the rest, by one share of white for each colour.

    The parameters follow such a light; the test counts what they leave in the residuals. A panel whose light is no
    power of its codes leaves much of the same. Only a fit without the shot tells which it is.
    """
    errors, jacobian = problem.errors_at(fitted.best.weight)(fitted.found.x)
    more, dof = np.zeros((3, *fitted.ratio.shape)), fitted.dof(problem.prior)
    more[np.arange(3), shot, np.arange(3)] = 1.0
    explained = fitted.beside_parameters(jacobian, more).explained(errors)
    return f_test(explained.chi2 / max(fitted.best.chi2 / dof, 1.0), explained.rank, dof)


def light_besides(problem: Problem, best: Profile) -> Float[np.ndarray, "3"]:
    """Return the light that is in the other shots but not in the dark frame, by colour, as a share of white."""
    return np.asarray((best.dark - problem.seen.rate[DARK]).sum(axis=1) / np.maximum(best.mask.sum(axis=1), 1e-12))


def brightness_of_white(problem: Problem, best: Profile) -> float:
    """Return the light of white over that which the pictures predict in a fit ``best`` without it."""
    seen, known = problem.seen, best.information
    white = seen.rate[WHITE] - seen.exposure_s[DARK] / seen.exposure_s[WHITE] * best.dark
    return float((known * best.mask * white).sum() / np.maximum((known * best.mask**2).sum(), 1e-12))
