"""The sensor's response that a noise fit found: mean signal for a given light (EMVA 1288, clause 6.7 judges it)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from udccal.models.noise import Noise
from udccal.result import FitResult


def mean_response(result: FitResult[Noise], light: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Mean signal above black in DN that the fitted response predicts; where it would pass saturation, saturation.

    Args:
        result: of the noise fit to frames or to a session.
        light: in the unit of the fitted levels (photons per pixel, or seconds).
    """
    numbers = {item.name: item.value for item in result.diagnostics}
    term = result.term
    black_DN = float(np.asarray(term.black_DN))
    linear = numbers["response_DN_per_light"] * (np.asarray(light) + numbers["light_offset"])
    bent = linear - numbers["curvature"] * (linear**2 + float(np.asarray(term.K_DN_per_e)) * linear)
    return np.minimum(bent, float(np.asarray(term.saturation_DN)) - black_DN)
