"""Is there a pattern in the residuals of the psf fit? A test, not an eye."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.special import ndtr

from udccal.fitting.psf.blocks import Block

# Samples this close together, in px, see the same feature of a kernel.
_NEAR_PX = 1.0
_BOUND = 3.0


def pattern_p_value(blocks: tuple[Block, ...], residuals: list[Float[np.ndarray, "shots n"]]) -> float:
    """Probability of residuals at least as alike in different pictures of a position, were they noise.

    Each picture has its own noise, and each samples the kernel at its own fraction of a pixel. Residuals of samples of
    one colour that see the same place of the kernel in two pictures, within a pixel, are therefore uncorrelated unless
    the model is wrong there; the mean of their products, in units of its standard error, is normal.

    Args:
        blocks: with their weights. residuals: data less expectation, e-/s.
    """
    total, count = 0.0, 0.0
    for block, residual in zip(blocks, residuals, strict=True):
        weight, colour = np.asarray(block.weight), np.asarray(block.colour).argmax(axis=-1)
        z = np.clip(residual * np.sqrt(weight), -_BOUND, _BOUND)
        z = np.where(weight > 0, z, 0.0)
        cells = np.floor(np.asarray(block.points) / _NEAR_PX).astype(np.int64)
        key = ((cells[..., 1] * 4096 + cells[..., 0]) * 3 + colour).ravel()
        _, cell = np.unique(key, return_inverse=True)
        shot = np.repeat(np.arange(len(z)), z.shape[1])
        sums = np.zeros((int(cell.max()) + 1, len(z)))
        np.add.at(sums, (cell, shot), z.ravel())
        square = (sums.sum(axis=1) ** 2 - (sums**2).sum(axis=1)) / 2.0
        power = np.zeros_like(sums)
        np.add.at(power, (cell, shot), z.ravel() ** 2)
        total += float(square.sum())
        count += float(((power.sum(axis=1) ** 2 - (power**2).sum(axis=1)) / 2.0).sum())
    return float(ndtr(-total / np.sqrt(count))) if count > 0 else 1.0
