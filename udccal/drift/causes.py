"""Which causes explain a change of the camera's pose: a movement, a turn, another focus, or several of them.

The fewest causes win whose absence of all others chance explains. With the change d and its covariance C, those left
out have chi-squared d_n' C_nn^-1 d_n; those that stay are solved for with the others at 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import final

import numpy as np
from jaxtyping import Float

from udccal.fitting.engine.gaussian import scaled_inverse
from udccal.fitting.engine.misfit import chi2_tail

# Places of each cause's numbers in ``PoseChange.values``.
CAUSES = {"moved": (3, 4, 5), "tilted": (0, 1, 2), "refocused": (6,)}


@final
@dataclass(frozen=True)
class Explained:
    """The causes found, and the change by these: 0 elsewhere, with the covariance that each other cause would have."""

    causes: tuple[str, ...]
    values: Float[np.ndarray, "7"]
    cov: Float[np.ndarray, "7 7"]


def explained(values: Float[np.ndarray, "7"], cov: Float[np.ndarray, "7 7"], chance: float) -> Explained:
    """Return the fewest causes that leave nothing that is less probable than ``chance``; of as many, the best."""
    for count in range(len(CAUSES) + 1):
        tried = [_by(causes, values, cov) for causes in combinations(CAUSES, count)]
        probability, found = max(tried, key=lambda one: one[0])
        if probability >= chance:
            break
    return found


def _by(
    causes: tuple[str, ...], values: Float[np.ndarray, "7"], cov: Float[np.ndarray, "7 7"]
) -> tuple[float, Explained]:
    """The probability of what these causes leave, and the change by them."""
    here = np.array(sorted(index for cause in causes for index in CAUSES[cause]), dtype=np.int64)
    rest = np.setdiff1d(np.arange(len(values)), here)
    inverse = scaled_inverse(cov[np.ix_(rest, rest)])
    left = float(values[rest] @ inverse @ values[rest])
    carried = cov[np.ix_(here, rest)] @ inverse
    only, spread = np.zeros(len(values)), np.zeros_like(cov)
    whole = scaled_inverse(cov)
    for name, places in CAUSES.items():
        if name not in causes:
            with_it = np.union1d(here, places)
            alone, at = scaled_inverse(whole[np.ix_(with_it, with_it)]), np.searchsorted(with_it, places)
            spread[np.ix_(places, places)] = alone[np.ix_(at, at)]
    only[here] = values[here] - carried @ values[rest]
    spread[np.ix_(here, here)] = cov[np.ix_(here, here)] - carried @ cov[np.ix_(rest, here)]
    return chi2_tail(left, len(rest)), Explained(causes, only, spread)
