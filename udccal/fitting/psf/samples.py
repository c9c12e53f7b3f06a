"""Which samples go into the fit of diffraction, and how much of what all of them tell they hold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool

from udccal.fitting.psf.blocks import Block, blocks, picked
from udccal.fitting.psf.descent import reduced, without_locals
from udccal.fitting.psf.diffraction import DiffractionFit, with_interference
from udccal.fitting.psf.normal import Normal, normal_equations
from udccal.fitting.psf.shots import Shots
from udccal.fitting.psf.weights import first_weights
from udccal.models.geometry import Geometry

_PEAK_HALF_PX = (12, 6)
# So many positions stand for all where the information left out is weighed.
_WEIGHED = 2


def choose_samples(shots: Shots, close: tuple[int, int], far_share: float) -> Bool[np.ndarray, "shots rows columns"]:
    """All samples about the peak and a seeded draw of the others up to ``close``, as many in every shot."""
    rng = np.random.default_rng(2)
    offsets = np.abs(shots.offsets())
    inside = (offsets[..., 0] <= close[1]) & (offsets[..., 1] <= close[0])
    near = (offsets[..., 0] <= _PEAK_HALF_PX[1]) & (offsets[..., 1] <= _PEAK_HALF_PX[0]) & inside
    far = np.flatnonzero((inside & ~near).ravel())
    chosen = np.tile(near.ravel(), (shots.count, 1))
    for row in chosen:
        row[rng.choice(far, round(len(far) * far_share), replace=False)] = True
    return chosen.reshape(shots.rate.shape)


def share_of_information(
    fit: DiffractionFit, shots: Shots, geometry: Geometry, close: tuple[int, int], available: int, reported: int
) -> float:
    """Variance that all samples of all pictures would leave over the variance of the fit, mean of its first numbers.

    Args:
        fit: the fit. shots: those that went into it, at the places that its blocks are about.
        close: windows of the fit. available: pictures there are. reported: how many numbers are looked at.
    """
    every = blocks(shots, geometry, choose_samples(shots, close, 1.0))
    size = np.shape(fit.problem.blocks[0].rate)[1]
    step = max(len(every) // _WEIGHED, 1)
    total, counted = np.zeros_like(fit.cov), 0
    for index in range(0, len(every), step):
        local, overlaps = fit.point.local[index], fit.problem.overlaps[index]
        alone = replace(fit.problem, blocks=(first_weights(every[index], fit.model_error),), overlaps=(overlaps,))
        (block,) = with_interference(alone, replace(fit.point, local=(local,)))
        evaluator = fit.problem.evaluator
        parts = [normal_equations(evaluator, fit.theta, part, local, overlaps) for part in _parts(block, size)]
        total += without_locals(_sum(parts))[0]
        counted += int((np.asarray(block.index) >= 0).sum())
    root = fit.problem.prior.root
    best = np.linalg.pinv(root.T @ root + total * (available / counted), hermitian=True)
    used = np.linalg.pinv(reduced(fit.problem, fit.point)[0], hermitian=True)
    return float(np.mean(np.diag(best)[:reported] / np.diag(used)[:reported]))


def _parts(block: Block, size: int) -> list[Block]:
    """Blocks of ``size`` samples each, for which the equations are compiled already; the last is filled up."""
    count = np.shape(block.rate)[1]
    made = []
    for start in range(0, count, size):
        index = np.minimum(np.arange(start, start + size), count - 1)
        real = np.arange(start, start + size) < count
        part = picked(block, index[None])
        made.append(replace(part, weight=np.asarray(part.weight) * real, known=np.asarray(part.known) * real))
    return made


def _sum(parts: list[Normal]) -> Normal:
    names = ("gg", "gl", "ll", "g", "l", "cost")
    return Normal(*(np.sum([np.asarray(getattr(part, name)) for part in parts], axis=0) for name in names))
