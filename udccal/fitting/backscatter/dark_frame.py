"""Whether the dark frame has the light that all other shots have besides the panel's.

Light that leaks in, or a panel whose black glows, is in every shot but the one with the panel off. Gamma would follow
it: dark places of pictures are brighter.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from udccal.fitting.backscatter.data import Profile
from udccal.fitting.backscatter.solve import Fitted, Problem
from udccal.fitting.engine.misfit import MisfitTest, f_test


def dark_frame_test(problem: Problem, fitted: Fitted) -> MisfitTest:
    """Test whether the dark frame has other light than the rest, by one share of white for each colour.

    The parameters follow such a light; the test counts what they leave in the residuals. A panel whose light is no
    power of its codes leaves much of the same. Only a fit without the dark frame tells which it is.
    """
    errors, jacobian = problem.errors_at(fitted.best.weight)(fitted.found.x)
    leak = np.zeros((3, *fitted.ratio.shape))
    leak[np.arange(3), -1, np.arange(3)] = 1.0
    dof = fitted.dof(problem.prior)
    explained = fitted.beside_parameters(jacobian, leak).explained(errors)
    return f_test(explained.chi2 / max(fitted.best.chi2 / dof, 1.0), explained.rank, dof)


def light_besides(problem: Problem, best: Profile) -> Float[np.ndarray, "3"]:
    """Return the light that is in the other shots but not in the dark frame, by colour, as a share of white."""
    return np.asarray((best.dark - problem.seen.rate[-1]).sum(axis=1) / np.maximum(best.mask.sum(axis=1), 1e-12))
