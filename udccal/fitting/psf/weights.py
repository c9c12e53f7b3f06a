"""What samples count for: the sensor's noise at the light that a model expects, how far the model is off, outliers.

What a model leaves out matters the more, relatively, the fainter a sample is: its standard deviation is taken as the
model error times light^(3/4) peak^(1/4), e.g. at 10^-4 of the peak ten times the model error. How large the model error
is, the residuals tell: it is the one of greatest likelihood, and none where that is no better by BIC.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
import scipy.optimize
from jaxtyping import Float
from scipy.special import ndtr

from udccal.fitting.engine.orders import bic
from udccal.fitting.engine.robust import Huber, OutlierRule, outliers
from udccal.fitting.psf.samples import Block
from udccal.fitting.psf.start import PsfRules
from udccal.result import Outliers

HUBER: Final = Huber()
_MODEL_ERRORS: Final = (1e-4, 0.5)
_LEAST_VARIANCE: Final = 1e-2
# Of residuals of at most so many sigma, so that one cosmic hit does not condemn its picture.
_PICTURE_SIGMA: Final = 3.0
_FEWEST_PICTURES: Final = 4


def left_out(light: Float[np.ndarray, "shots n"], model_error: float) -> Float[np.ndarray, "shots n"]:
    """Standard deviation of what the model leaves out of samples that it expects to be this bright."""
    size = np.maximum(light, 0.0)
    return model_error * size**0.75 * size.max(axis=-1, keepdims=True) ** 0.25


def noise_at(
    level: Float[np.ndarray, "*n"],
    rate: Float[np.ndarray, "*n"],
    measured: Float[np.ndarray, "*n"],
    noise_per_rate: Float[np.ndarray, "*n"],
) -> Float[np.ndarray, "*n"]:
    """Variance of samples whose true rate is ``level``, if it was ``measured`` to be that of the ``rate`` found."""
    change = noise_per_rate * (np.maximum(level, 0.0) - np.maximum(rate, 0.0))
    # A sensor without read noise has no variance at all where no light is expected.
    return np.maximum(measured + change, _LEAST_VARIANCE * measured)


def sensor_variance(block: Block, level: Float[np.ndarray, "shots n"]) -> Float[np.ndarray, "shots n"]:
    """Variance of the samples' noise if their true rate is ``level``; 1 where there is no sample."""
    known, rate = np.asarray(block.known), np.asarray(block.rate)
    measured = 1.0 / np.where(known > 0, known, 1.0)
    return noise_at(level, rate, measured, np.asarray(block.noise_per_rate) * (known > 0))


def weighed(
    block: Block, model_error: float, light: np.ndarray | None = None, background: np.ndarray | None = None
) -> Block:
    """The block with weights at the ``light`` (shots n) and ``background`` (shots) that a model expects, in e-/s.

    Before there is a model the data stand for it.
    """
    seen = np.asarray(block.known) > 0
    light = np.asarray(block.rate) if light is None else light
    level = light if background is None else light + background[:, None]
    variance = sensor_variance(block, level) + left_out(light * seen, model_error) ** 2
    return replace(block, weight=np.where(seen, 1.0 / variance, 0.0))


def estimate_model_error(
    residual: Float[np.ndarray, " samples"],
    variance: Float[np.ndarray, " samples"],
    share: Float[np.ndarray, " samples"],
    parameters: int,
) -> float:
    """Model error of greatest likelihood; 0 where the noise alone explains the residuals as well, by BIC.

    Args:
        residual: data less expectation.
        variance: of the sensor's noise.
        share: what a model error of 1 would add to a sample's standard deviation.
        parameters: that were fitted; residuals are smaller than errors by what they took up.
    """
    raised = residual**2 * (residual.size / max(residual.size - parameters, 1))

    def loss(model_error: float) -> float:
        total = variance + (model_error * share) ** 2
        return float(np.sum(np.log(total) + HUBER.loss(np.sqrt(raised / total))))

    log_bounds = (np.log(_MODEL_ERRORS[0]), np.log(_MODEL_ERRORS[1]))
    found = scipy.optimize.minimize_scalar(lambda log: loss(float(np.exp(log))), bounds=log_bounds, method="bounded")
    return float(np.exp(found.x)) if bic(float(found.fun), 1.0, residual.size) < loss(0.0) else 0.0


def without_outliers(
    blocks: Sequence[Block], errors: Sequence[Float[np.ndarray, "shots n"]], rules: PsfRules
) -> tuple[tuple[Block, ...], tuple[Outliers, ...]]:
    """Blocks in which outliers have no weight, and what was left out: pictures first, then samples of the others.

    ``errors`` are data less expectation in units of sigma. A picture that fits so much worse than the others shows that
    something moved, flickered or was in the way: that needs a rule of its own beside the engine's of single samples.
    """
    used = np.stack([np.asarray(block.weight) > 0 for block in blocks])
    index, z = np.stack([np.asarray(block.index) for block in blocks]), np.stack(errors)
    square = (np.minimum(z**2, _PICTURE_SIGMA**2) * used).sum(axis=-1) / np.maximum(used.sum(axis=-1), 1)
    real = index >= 0
    worst = rules.picture_times * max(float(np.median(square[real])), 1.0)
    moved = real & (square > worst) & (real.sum() >= _FEWEST_PICTURES)
    rule = OutlierRule("samples")
    off = rule.off(z, used & ~moved[..., None])
    pictures = (f"picture {index[at]} at position {at[0]}" for at in zip(*np.nonzero(moved), strict=True))
    samples = (
        f"picture {index[at[:2]]} at position {at[0]}, {z[at]:+.0f} sigma" for at in zip(*np.nonzero(off), strict=True)
    )
    said = f"pictures whose mean squared residual is over {rules.picture_times:g} times the median picture's"
    kept = np.stack([np.asarray(block.weight) for block in blocks]) * ~(off | moved[..., None])
    cleaned = tuple(replace(block, weight=weight) for block, weight in zip(blocks, kept, strict=True))
    return cleaned, (*outliers(said, pictures), *rule.listed(samples))


def pattern_p_value(blocks: Sequence[Block], errors: Sequence[Float[np.ndarray, "shots n"]]) -> float:
    """Probability of residuals at least as alike in different pictures of a position, were they noise.

    Each picture has its own noise, and each samples the kernel at its own fraction of a pixel. Residuals of samples of
    one colour that see the same place of the kernel in two pictures, within a pixel, are therefore uncorrelated unless
    the model is wrong there; the mean of their products, in units of its standard error, is normal. Means of groups
    (``engine.misfit``) hold squares besides, which tell nothing and hide what two pictures have in common.

    Args:
        blocks: with their weights. errors: data less expectation, in units of sigma.
    """
    total, variance = 0.0, 0.0
    for block, error in zip(blocks, errors, strict=True):
        z = np.clip(error, -HUBER.sigma, HUBER.sigma).ravel()
        x, y = np.moveaxis(np.floor(np.asarray(block.points)).astype(np.int64), -1, 0)
        key = (y * 4096 + x) * 3 + np.asarray(block.colour).argmax(axis=-1)
        cell = np.unique(key, return_inverse=True)[1].reshape(-1)
        shot = np.repeat(np.arange(len(error)), error.shape[1])
        sums, squares = (np.zeros((int(cell.max()) + 1, len(error))) for _ in range(2))
        np.add.at(sums, (cell, shot), z)
        np.add.at(squares, (cell, shot), z**2)
        # Of pairs of different pictures alone.
        total += float((sums.sum(axis=1) ** 2 - (sums**2).sum(axis=1)).sum()) / 2.0
        variance += float((squares.sum(axis=1) ** 2 - (squares**2).sum(axis=1)).sum()) / 2.0
    return float(ndtr(-total / np.sqrt(variance))) if variance > 0 else 1.0
