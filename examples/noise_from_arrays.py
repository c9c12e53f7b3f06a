"""Fit a sensor's noise to pairs of frames at several exposures; a frame may also be a function that loads it.

python examples/noise_from_arrays.py
"""

from __future__ import annotations

import numpy as np

import udccal
from udccal.fitting.noise.data import ExposureLevel, NoiseData

GAIN_DN_PER_E, READ_E, BLACK_DN, WELL_E = 0.36, 4.0, 64.0, 10_000.0


def main() -> None:
    """Draw the frames of a toy sensor, fit them, and print the estimates with their sigmas."""
    rng = np.random.default_rng(0)
    response = 1 + 0.006 * rng.standard_normal((192, 256))

    def pair(electrons: float) -> tuple[np.ndarray, np.ndarray]:
        counts = np.minimum(rng.poisson(electrons * response, (2, *response.shape)), WELL_E)
        codes = BLACK_DN + GAIN_DN_PER_E * (counts + READ_E * rng.standard_normal(counts.shape))
        first, second = np.clip(np.rint(codes), 0, 4095).astype(np.uint16)
        return first, second

    exposures_s = np.linspace(0.005, 0.12, 10)
    levels = [ExposureLevel(float(t), dark=pair(0.0), bright=pair(10 * WELL_E * t)) for t in exposures_s]
    result = udccal.fit_noise(NoiseData(levels))
    print(f"{result.status.name}: {result.status.value}")
    print(*(f"  {e.name:22} {e.value:12.5g} ± {e.sigma:.2g} {e.unit}" for e in result.estimates), sep="\n")
    print(*(f"  {candidate.name}" for candidate in result.candidates if candidate.chosen), sep="\n")


if __name__ == "__main__":
    main()
