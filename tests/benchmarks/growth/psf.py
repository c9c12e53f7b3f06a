"""The psf of a rig: positions of the LED, and pixels of the window about it; a few iterations of the fit."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tests.benchmarks.growth.cases import Case
from tests.scenes.psf import pictures, shots_of, small_scene
from udccal.fitting.psf.data import PsfRules
from udccal.fitting.psf.diffraction import fit_diffraction
from udccal.fitting.psf.start import start_model, start_prior
from udccal.numerics import in_float64

_ITERATIONS = 4
# Columns and rows of positions; (rows, columns) to either side of the LED by the pixels of a window.
_GRIDS = {3: (3, 1), 6: (3, 2), 12: (4, 3)}
_HALVES = {231: (10, 5), 435: (14, 7), 861: (20, 10)}
_POSITIONS, _PIXELS = 6, 231


@in_float64
def _work(positions: int, pixels: int) -> Callable[[], object]:
    scene = small_scene(_GRIDS[positions], shifts=2, half=_HALVES[pixels])
    start = start_model(scene.rig, scene.geometry, scene.wire)
    prior = start_prior(scene.rig, start)
    rules = PsfRules(close_px=scene.half, far_fraction=1.0, iterations=_ITERATIONS)
    rng = np.random.default_rng(1)
    shots = shots_of(scene, pictures(scene, prior.mean, rng), rng)

    @in_float64
    def work() -> object:
        return fit_diffraction(shots, scene.geometry, start, prior, rules)

    return work


CASES = (
    Case("psf", "positions", tuple(_GRIDS), lambda positions: _work(positions, _PIXELS)),
    Case("psf", "pixels of a window", tuple(_HALVES), lambda pixels: _work(_POSITIONS, pixels)),
)
