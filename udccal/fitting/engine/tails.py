"""Tail probabilities of chi-squared and F: how often chance alone reaches a statistic.

They come from ``scipy.special``: ``scipy.stats`` takes longer to load than everything else that a fit needs.
"""

from __future__ import annotations

from typing import SupportsFloat

from scipy.special import chdtrc, fdtrc


def chi2_tail(statistic: SupportsFloat, dof: SupportsFloat) -> float:
    """Probability that chi-squared of ``dof`` degrees of freedom is above ``statistic``.

    Args:
        statistic: a sum of squares of unit normals.
        dof: its degrees of freedom.

    Returns:
        from 0 to 1; 1 where there are no degrees of freedom.
    """
    return float(chdtrc(float(dof), max(float(statistic), 0.0))) if float(dof) > 0 else 1.0


def f_tail(statistic: SupportsFloat, above: SupportsFloat, below: SupportsFloat) -> float:
    """Probability that F is above ``statistic``; 1 where numerator or denominator has no degrees of freedom."""
    degrees = float(above), float(below)
    return float(fdtrc(*degrees, max(float(statistic), 0.0))) if min(degrees) > 0 else 1.0
