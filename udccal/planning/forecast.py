"""The sigma expected of a term's captures: as planned, in the limit of endless ones, and against the number of each.

Every term has a predictor. It puts expected data at the planned exposures through the equations of the term's own fit.
Their information gives the sigma of one quantity, which stands for the term.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final, final

import numpy as np
from jaxtyping import Float

from udccal.planning.backscatter import BackscatterPredictor
from udccal.planning.design import DESIGN_VARIABLES, QUANTITIES, DesignVariable, Limits, Predictor, Quantity
from udccal.planning.geometry import GeometryPredictor
from udccal.planning.noise import NoisePredictor
from udccal.planning.psf import PsfPredictor
from udccal.planning.state import RigState
from udccal.planning.wire import WirePredictor
from udccal.rig import Captures
from udccal.sessions.schema import TermName

# Curves reach from a quarter of what was captured to four times as much.
_REACH: Final = np.geomspace(1 / 4, 4, 9)
# Design variables that change sigma by less than this part of it do not matter to the quantity.
_FLAT: Final = 1e-3
PREDICTORS: Final[Mapping[TermName, Callable[[RigState], Predictor]]] = {
    "noise": NoisePredictor,
    "geometry": GeometryPredictor,
    "wire": WirePredictor,
    "psf": PsfPredictor,
    "backscatter": BackscatterPredictor,
}


@final
@dataclass(frozen=True)
class Curve:
    """Sigma against one design variable, the others unchanged; ``now`` is the number that was captured."""

    variable: DesignVariable
    now: int
    counts: Float[np.ndarray, " n"]
    sigma: Float[np.ndarray, " n"]

    @property
    def most_gain(self) -> float:
        """Factor by which sigma falls from ``now`` to the largest of ``counts``."""
        at = float(np.exp(np.interp(np.log(self.now), np.log(self.counts), np.log(self.sigma))))
        return at / float(self.sigma[-1])


@final
@dataclass(frozen=True)
class Forecast:
    """The sigma that a term's captures give, and that more or fewer of them would give.

    Attributes:
        quantity: name of the quantity that ``sigma`` belongs to, and its unit.
        sigma: predicted for the present captures.
        limits: what bounds sigma apart from the number of captures.
        curves: one per design variable on which sigma depends.
        idle: names of the other design variables, in words.
    """

    term: TermName
    quantity: Quantity
    sigma: float
    limits: Limits
    curves: tuple[Curve, ...]
    idle: tuple[str, ...]


def forecast(term: TermName, state: RigState) -> Forecast | None:
    """Forecast the sigma of one term for the rig's present captures; None where these do not suffice for a fit.

    Raises:
        UdccalError: as ``steps_at``.
    """
    predictor, captures = PREDICTORS[term](state), state.rig.captures
    sigma = predictor.sigma(captures)
    if not (np.isfinite(sigma) and sigma > 0):
        return None
    curves = [_curve(predictor, captures, variable) for variable in DESIGN_VARIABLES[term]]
    matter = tuple(curve for curve in curves if len(curve.counts) > 1 and np.ptp(curve.sigma) > _FLAT * sigma)
    idle = tuple(curve.variable.counted for curve in curves if curve not in matter)
    return Forecast(term, QUANTITIES[term], sigma, predictor.limits(captures), matter, idle)


def _curve(predictor: Predictor, captures: Captures, variable: DesignVariable) -> Curve:
    now = variable.of(captures)
    wanted = np.clip(np.rint(now * _REACH), min(variable.least, now), max(variable.most, now))
    counts = np.unique(wanted)
    sigma = np.array([predictor.sigma(variable.set(captures, int(count))) for count in counts])
    finite = np.isfinite(sigma)
    return Curve(variable, now, counts[finite], sigma[finite])
