"""Merge a bracket of exposures into one linear picture with error bars, and list the outliers.

    python examples/merge_bracket.py

Ten exposures of a simulated scene over six decades of light. One frame was taken while the lamp flickered, and a cosmic
ray hit another.
"""

from __future__ import annotations

import numpy as np

from udccal.fitting.hdr.merge import merge_bracket
from udccal.models.noise import Noise

SENSOR = Noise(
    K_DN_per_e=0.36,
    black_DN=64.0,
    saturation_DN=4095.0,
    sigma_d_e=4.0,
    lambda_read=0.14,
    sigma_row_DN=0.0,
    q_DN=1.0,
    dark_current_e_per_s=0.0,
    DSNU1288_e=0.0,
    PRNU1288=0.0,
)
EXPOSURES_S = 1e-4 * 2.0 ** np.arange(10)


def main() -> None:
    rng = np.random.default_rng(1)
    rate = np.geomspace(1e2, 1e8, 200 * 300).reshape(200, 300)
    lamp = np.where(np.arange(10) == 4, 0.93, 1.0)
    electrons = rng.poisson(rate * (lamp * EXPOSURES_S)[:, None, None])
    codes = np.rint(64 + 0.36 * (electrons + 4.0 * rng.standard_normal(electrons.shape)))
    frames = np.clip(codes, 0, 4095).astype(np.uint16)
    frames[9, 20, 30] = 3000
    merged = merge_bracket(frames, EXPOSURES_S, SENSOR)
    z = (merged.rate_e_per_s - rate) / merged.sigma_e_per_s
    print(f"error in units of its sigma: mean {z.mean():+.3f}, standard deviation {z.std():.3f}")
    for outlier in merged.outliers:
        print(f"left out: {outlier.count} ({', '.join(outlier.places)}): {outlier.rule}")


if __name__ == "__main__":
    main()
