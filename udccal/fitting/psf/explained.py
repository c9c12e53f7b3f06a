"""What diffraction alone explains of every picture, once its numbers are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from udccal.fitting.psf.blocks import blocks, fit_lattice
from udccal.fitting.psf.diffraction import DiffractionFit, fit_locals
from udccal.fitting.psf.residual import Sources, with_light_of_peak
from udccal.fitting.psf.shots import Shots
from udccal.models.geometry import Geometry


def explain(
    shots: Shots, geometry: Geometry, fit: DiffractionFit, half: tuple[int, int]
) -> tuple[Sources, Float[np.ndarray, "shots rows columns"]]:
    """Places and light of all shots under the fitted model, and what it expects of every sample per unit of light.

    ``half`` is the window's (rows, columns) to either side of the LED.
    """
    evaluator = replace(fit.problem.evaluator, lattice=fit_lattice(half))
    place, flux, background = shots.centre_px.copy(), np.zeros((shots.count, 3)), np.zeros(shots.count)
    explained = np.zeros(shots.rate.shape)
    for block in blocks(shots, geometry, np.ones(shots.rate.shape, dtype=bool)):
        local, unit = fit_locals(evaluator, fit.theta, block, fit.model_error)
        index = np.asarray(block.index)
        real = index >= 0
        place[index[real]] += np.asarray(local.offset_px)[real]
        flux[index[real]], background[index[real]] = np.asarray(local.flux)[real], np.asarray(local.background)[real]
        explained[index[real]] = unit[real].reshape(-1, *shots.rate.shape[1:])
    return with_light_of_peak(shots, Sources(place, flux, background), explained), explained
