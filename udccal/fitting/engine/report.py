"""A fit's numbers for a report: estimates in their units, and a sample of the residuals."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from udccal.result import Estimate, ResidualSample

_MOST_RESIDUALS = 6000


def estimates(
    names: Sequence[str],
    units: Sequence[str],
    values: Float[np.ndarray, " n"],
    cov: Float[np.ndarray, "n n"],
) -> tuple[Estimate, ...]:
    """Named quantities with one standard deviation each.

    Args:
        names: of the quantities.
        units: one per name.
        values: one per name, in its unit.
        cov: covariance, in the order of the names; further rows are ignored.
    """
    sigma = np.sqrt(np.maximum(np.diag(cov), 0.0))
    return tuple(
        Estimate(name, float(value), float(one), unit)
        for name, unit, value, one in zip(names, units, values, sigma[: len(names)], strict=True)
    )


def residual_sample(positions_px: Float[np.ndarray, "n 2"], z: Float[np.ndarray, " n"]) -> ResidualSample:
    """A few thousand of the residuals at most, drawn evenly in the order given.

    Args:
        positions_px: (x, y) of each residual on the sensor.
        z: residuals in units of their sigma.
    """
    drawn = np.s_[:: max(1, -(-len(z) // _MOST_RESIDUALS))]
    return ResidualSample(np.asarray(positions_px[drawn], dtype=np.float64), np.asarray(z[drawn], dtype=np.float64))
