"""Fit a psf field to stamps of point sources, print the chosen order, and predict kernels with their error bars.

python examples/psf_from_stamps.py
"""

from __future__ import annotations

import numpy as np

from udccal.fitting.psf_stamps.data import Stamps
from udccal.fitting.psf_stamps.fit import fit_psf_stamps

COLUMNS, ROWS, SIZE, READ_E = 1000, 800, 15, 4.0


def light(position_px: np.ndarray, shift_px: np.ndarray) -> np.ndarray:
    """Return a round star that is wider towards the corners."""
    x, y = 2 * position_px / [COLUMNS, ROWS] - 1
    sigma = 1.3 * (1 + 0.15 * (x * x + y * y))
    v, u = np.mgrid[:SIZE, :SIZE] - SIZE // 2
    return np.exp(-0.5 * ((u - shift_px[0]) ** 2 + (v - shift_px[1]) ** 2) / sigma**2) / (2 * np.pi * sigma**2)


def main() -> None:
    rng = np.random.default_rng(0)
    position = rng.uniform(0.05, 0.95, (25, 2)) * [COLUMNS, ROWS]
    middle = np.rint(position).astype(np.int64)
    mean = np.array([1e5 * light(p, p - m) for p, m in zip(position, middle, strict=True)])
    stamps = Stamps(rng.poisson(mean) + READ_E * rng.standard_normal(mean.shape), middle, READ_E)

    result = fit_psf_stamps(stamps)
    print(f"{result.status.name}: {result.status.value}")
    for candidate in result.candidates:
        print(f"  {'>' if candidate.chosen else ' '} {candidate.name:50} {candidate.criterion:.1f}")
    term = result.or_raise().term

    corner = np.array([[60.0, 40.0]])
    kernel, sigma = term.predict(corner)[0], term.sigma(corner)[0]
    print(f"In the corner the peak is {kernel.max():.4f} ± {sigma.ravel()[kernel.argmax()]:.4f} of the light;")
    print(f"the kernel is known to {100 * term.relative_l2(corner)[0, 0]:.2f} % of its norm.")


if __name__ == "__main__":
    main()
