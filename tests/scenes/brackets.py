"""Brackets of a sensor whose noise is known: frames of growing exposure of one rate of light, or of a map of rates."""

from __future__ import annotations

import numpy as np

from udccal.models.noise import Noise

NOISE = Noise(
    K_DN_per_e=0.355,
    black_DN=64.3,
    saturation_DN=3960.0,
    sigma_d_e=4.5,
    lambda_read=0.1,
    sigma_row_DN=0.0,
    q_DN=1.0,
    dark_current_e_per_s=20.0,
    DSNU1288_e=0.0,
    PRNU1288=0.0,
)
EXPOSURES = 1e-4 * 4.0 ** np.arange(7)


def bracket(
    rate: float | np.ndarray, exposures: np.ndarray, seed: int, shape: tuple[int, int] = (120, 120)
) -> np.ndarray:
    """Codes of 12 bits at light of so many e-/s."""
    rng = np.random.default_rng(seed)
    electrons = [
        np.minimum(rng.poisson((rate + 20.0) * t, shape), (3960.0 - 64.3) / 0.355) + 4.5 * rng.standard_normal(shape)
        for t in exposures
    ]
    return np.clip(np.rint(64.3 + 0.355 * np.array(electrons)), 0, 4095).astype(np.uint16)
