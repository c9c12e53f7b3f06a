"""What captures of a term have brought, and what more or fewer of them would: accuracy against the number captured."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, final

import numpy as np
from jaxtyping import Float

from udccal.planning.knobs import KNOBS, Knob
from udccal.planning.prediction import Floor, Predictor
from udccal.planning.predictors import predictor_for
from udccal.planning.state import RigState
from udccal.planning.targets import QUANTITIES, Quantity
from udccal.rig import Captures
from udccal.sessions.schema import TermName

# From a quarter of what was captured to four times as much.
_REACH: Final = 4.0
_POINTS: Final = 9
# Numbers that change sigma by less than this share of it do not matter to the quantity.
_FLAT: Final = 1e-3


@final
@dataclass(frozen=True)
class Trade:
    """Sigma against one number of the captures, all others as they were; ``now`` is what was captured."""

    knob: Knob
    now: int
    counts: Float[np.ndarray, " n"]
    sigma: Float[np.ndarray, " n"]

    @property
    def most_gain(self) -> float:
        """By which factor sigma falls from what was captured to the most that is looked at."""
        at = float(np.exp(np.interp(np.log(self.now), np.log(self.counts), np.log(self.sigma))))
        return at / float(self.sigma[-1])


@final
@dataclass(frozen=True)
class Outlook:
    """What a term's captures bring.

    Attributes:
        quantity: what ``sigma`` is of, and its unit.
        sigma: predicted at what was captured.
        floor: what no captures get below.
        used: share of the frames' information on the quantity that the fit, at its default effort, spends; 1 is all.
        trades: one per number that matters.
        idle: what the numbers count that do not matter to the quantity.
    """

    term: TermName
    quantity: Quantity
    sigma: float
    floor: Floor
    used: float
    trades: tuple[Trade, ...]
    idle: tuple[str, ...]


def outlook(term: TermName, state: RigState) -> Outlook | None:
    """Of one term at a state's captures; None where these do not suffice for a fit.

    Raises:
        UdccalError: when no procedure is installed, or the one that is does not tell what it will take.
    """
    predictor, captures = predictor_for(term, state), state.rig.captures
    sigma = predictor.sigma(captures)
    if not (np.isfinite(sigma) and sigma > 0):
        return None
    trades = [_trade(predictor, captures, knob) for knob in KNOBS[term]]
    matter = [trade for trade in trades if len(trade.counts) > 1 and np.ptp(trade.sigma) > _FLAT * sigma]
    idle = tuple(trade.knob.counted for trade in trades if trade not in matter)
    used = predictor.used(captures)
    return Outlook(term, QUANTITIES[term], sigma, predictor.floor(), used, tuple(matter), idle)


def _trade(predictor: Predictor, captures: Captures, knob: Knob) -> Trade:
    counts = list(_counts(knob, knob.of(captures)))
    sigma = np.array([predictor.sigma(knob.set(captures, count)) for count in counts])
    told = np.isfinite(sigma)
    return Trade(knob, knob.of(captures), np.array(counts, dtype=np.float64)[told], sigma[told])


def _counts(knob: Knob, now: int) -> Iterator[int]:
    """From a quarter of ``now`` to four times as many, within what can be asked for."""
    low, high = min(knob.least, now), max(knob.most, now)
    wanted = np.rint(now * np.geomspace(1 / _REACH, _REACH, _POINTS)).astype(int)
    yield from np.unique(np.clip(wanted, low, high)).tolist()
