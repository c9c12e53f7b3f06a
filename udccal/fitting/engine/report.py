"""A fit's numbers, gathered for a person: estimates in their units, residuals evenly drawn."""

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
    """Named quantities with one standard deviation each; ``cov`` may have more rows than there are names."""
    sigma = np.sqrt(np.maximum(np.diag(cov), 0.0))
    return tuple(
        Estimate(name, float(value), float(one), unit)
        for name, unit, value, one in zip(names, units, values, sigma[: len(names)], strict=True)
    )


def residual_sample(positions_px: Float[np.ndarray, "n 2"], z: Float[np.ndarray, " n"]) -> ResidualSample:
    """At most some thousand of the residuals, evenly drawn in the order given."""
    drawn = np.s_[:: max(1, -(-len(z) // _MOST_RESIDUALS))]
    return ResidualSample(np.asarray(positions_px[drawn], dtype=np.float64), np.asarray(z[drawn], dtype=np.float64))
