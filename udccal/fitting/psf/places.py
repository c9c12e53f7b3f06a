"""Where each LED is to begin with: the best of a grid of places about the brightest spot.

A centroid will not do: neighbouring diffraction orders are half as bright as the middle one, and the mosaic samples
each colour unevenly, so it can be off by a pixel; a descent from there ends on a neighbouring order.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from udccal.fitting.psf.blocks import Block, Local, picked
from udccal.fitting.psf.normal import Evaluator, unit_light, unit_light_at

_GRID_PX = np.linspace(-1.25, 1.25, 11)
_CORE_SAMPLES = 117
# Part of the signal that is added to the noise: far from the solution the model is no better than this.
_TRUST = 0.1


def start_local(evaluator: Evaluator, block: Block, coefficients: Float[np.ndarray, "rows columns 3"]) -> Local:
    """Start of every shot's own unknowns: place by search, light and background by least squares."""
    core = _core(block)
    moves = np.stack(np.meshgrid(_GRID_PX, _GRID_PX), axis=-1).reshape(-1, 2)
    tried = np.asarray(unit_light_at(evaluator, core, moves, coefficients))
    shots = range(np.shape(block.rate)[0])
    offset = np.stack([moves[np.argmin(_linear(core, tried[:, s], s)[1])] for s in shots])
    unit = np.asarray(unit_light(evaluator, block, offset, coefficients))
    linear = np.stack([_linear(block, unit[None, s], s)[0][0] for s in shots])
    return Local(offset, linear[:, :3], linear[:, 3])


def _core(block: Block) -> Block:
    """The samples next to the brightest spot alone."""
    points = np.asarray(block.points)
    near = np.argsort((points**2).sum(axis=-1), axis=1, kind="stable")[:, :_CORE_SAMPLES]
    return picked(block, near)


def _linear(
    block: Block, units: Float[np.ndarray, "moves n"], shot: int
) -> tuple[Float[np.ndarray, "moves 4"], Float[np.ndarray, " moves"]]:
    """Light per colour and background of one shot for each of several expectations, and the cost that remains."""
    rate, weight = np.asarray(block.rate)[shot], np.asarray(block.weight)[shot]
    known = weight > 0
    variance = 1.0 / np.where(known, weight, 1.0) + (_TRUST * np.maximum(rate, 0.0)) ** 2
    root = np.where(known, 1.0 / np.sqrt(variance), 0.0)
    coloured = units[..., None] * np.asarray(block.colour)[shot]
    design = np.concatenate([coloured, np.ones((*units.shape, 1))], axis=-1) * root[:, None]
    size = np.maximum(np.linalg.norm(design, axis=1, keepdims=True), 1e-30)
    inverse = np.linalg.pinv(np.einsum("mnk,mnl->mkl", design / size, design / size), rcond=1e-12, hermitian=True)
    solution = np.einsum("mkl,mnl,n->mk", inverse, design / size, rate * root, optimize=True)
    # Without the bound a place where nothing is expected would fit a dark neighbourhood best.
    left = np.minimum(np.abs(rate * root - np.einsum("mnk,mk->mn", design / size, solution)), 10.0)
    return solution / size[:, 0], (left**2).sum(axis=-1)
