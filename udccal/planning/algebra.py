"""Inverting information matrices whose parameters are of very different size."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def covariance(information: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """The inverse; what the data do not tell at all gets no variance, so that priors must hold it."""
    unit = 1 / np.sqrt(np.diag(information))
    return np.asarray(np.linalg.pinv(information * np.outer(unit, unit), hermitian=True) * np.outer(unit, unit))


def without(information: Float[np.ndarray, "all all"], kept: int) -> Float[np.ndarray, "kept kept"]:
    """What is left on the first ``kept`` parameters when the others are estimated, too (Schur's complement)."""
    cross = information[:kept, kept:]
    return np.asarray(information[:kept, :kept] - cross @ covariance(information[kept:, kept:]) @ cross.T)
