"""Inverting information matrices whose parameters are of very different size."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from udccal.fitting.engine.gaussian import scaled_inverse


def covariance(information: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """The inverse; what the data do not tell at all gets no variance, so that priors must hold it."""
    return scaled_inverse(information, 1e-15)


def without(information: Float[np.ndarray, "all all"], kept: int) -> Float[np.ndarray, "kept kept"]:
    """What is left on the first ``kept`` parameters when the others are estimated, too (Schur's complement)."""
    cross = information[:kept, kept:]
    return np.asarray(information[:kept, :kept] - cross @ covariance(information[kept:, kept:]) @ cross.T)
