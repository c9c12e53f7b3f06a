"""How often chance alone reaches a statistic.

Of ``scipy.special``: ``scipy.stats`` has the same numbers, and takes longer to load than all else a fit needs.
"""

from __future__ import annotations

from typing import SupportsFloat

from scipy.special import chdtrc, fdtrc


def chi2_tail(statistic: SupportsFloat, dof: SupportsFloat) -> float:
    """Probability that chi-squared of ``dof`` degrees of freedom is above ``statistic``; 1 where there are none."""
    return float(chdtrc(float(dof), max(float(statistic), 0.0))) if float(dof) > 0 else 1.0


def f_tail(statistic: SupportsFloat, above: SupportsFloat, below: SupportsFloat) -> float:
    """Probability that F of so many degrees of freedom is above ``statistic``; 1 where there are none of either."""
    degrees = float(above), float(below)
    return float(fdtrc(*degrees, max(float(statistic), 0.0))) if min(degrees) > 0 else 1.0
