"""Fit a sensor's noise to frames as arrays: pairs at several exposures, and stacks for the fixed pattern.

python examples/noise_from_arrays.py                 # draws the frames of a toy sensor first
python examples/noise_from_arrays.py FOLDER          # dark_0.npy, dark_1.npy, bright_0.npy, bright_1.npy in folders
                                                     # named by their exposure in seconds, such as 0.02
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

import numpy as np

from udccal.fitting.noise.data import ExposureLevel, NoiseData
from udccal.fitting.noise.fit import fit_noise

GAIN_DN_PER_E, READ_E, BLACK_DN, WELL_E = 0.36, 4.0, 64.0, 10_000.0


def toy_levels() -> list[ExposureLevel]:
    rng = np.random.default_rng(0)
    response = 1 + 0.006 * rng.standard_normal((192, 256))

    def frame(electrons: float) -> np.ndarray:
        counts = np.minimum(rng.poisson(electrons * response), WELL_E)
        codes = BLACK_DN + GAIN_DN_PER_E * (counts + READ_E * rng.standard_normal(response.shape))
        return np.clip(np.rint(codes), 0, 4095).astype(np.uint16)

    rate = WELL_E / 0.1
    return [
        ExposureLevel(float(t), dark=(frame(0.0), frame(0.0)), bright=(frame(rate * t), frame(rate * t)))
        for t in np.linspace(0.005, 0.12, 10)
    ]


def levels_of(folder: Path) -> list[ExposureLevel]:
    """Return data that load their frames one by one when they are needed."""

    def pair(place: Path, kind: str) -> tuple[partial[np.ndarray], ...]:
        return tuple(partial(np.load, place / f"{kind}_{i}.npy") for i in (0, 1))

    return [
        ExposureLevel(float(place.name), pair(place, "dark"), pair(place, "bright"))
        for place in sorted(folder.iterdir(), key=lambda place: float(place.name))
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?")
    folder = parser.parse_args().folder
    result = fit_noise(NoiseData(toy_levels() if folder is None else levels_of(folder)))
    print(f"{result.status.name}: {result.status.value}")
    for estimate in result.estimates:
        print(f"  {estimate.name:22} {estimate.value:12.5g} ± {estimate.sigma:.2g} {estimate.unit}")
    for candidate in result.candidates:
        if candidate.chosen:
            print(f"  {candidate.name}")
    for note in result.notes:
        print(f"  {note}")


if __name__ == "__main__":
    main()
