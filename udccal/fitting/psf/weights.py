"""What the diffraction fit goes by, sample by sample: the sensor's noise at the light that the model expects, and how
far the model itself is off there.

What a model leaves out matters the more, relatively, the fainter a sample is: its standard deviation is taken as the
model error times light^(3/4) peak^(1/4), e.g. at 10^-4 of the peak ten times the model error. How large the model error
is, the residuals tell: it is the one of greatest likelihood, and none where that is no better by BIC.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.optimize
from jaxtyping import Float

from udccal.fitting.psf.blocks import Block, Local

_ROBUST = 3.0
_LEAST, _MOST = 1e-4, 0.5
_LEAST_VARIANCE = 1e-2


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


def first_weights(block: Block, model_error: float) -> Block:
    """Weights before there is a model: the data stand for it."""
    rate, known = np.asarray(block.rate), np.asarray(block.known)
    variance = 1.0 / np.where(known > 0, known, 1.0) + left_out(rate * (known > 0), model_error) ** 2
    return replace(block, weight=np.where(known > 0, 1.0 / variance, 0.0))


def model_weights(block: Block, light: Float[np.ndarray, "shots n"], local: Local, model_error: float) -> Block:
    """Weights at the light that the model expects, without background."""
    seen = np.asarray(block.known) > 0
    variance = sensor_variance(block, light + np.asarray(local.background)[:, None])
    variance = variance + left_out(light * seen, model_error) ** 2
    return replace(block, weight=np.where(seen, 1.0 / variance, 0.0))


def huber(size: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Squares of residuals in units of their sigma, growing no more than linearly beyond three."""
    return np.where(size < _ROBUST, size**2, 2 * _ROBUST * size - _ROBUST**2)


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
        return float(np.sum(np.log(total) + huber(np.sqrt(raised / total))))

    found = scipy.optimize.minimize_scalar(
        lambda log: loss(float(np.exp(log))), bounds=(np.log(_LEAST), np.log(_MOST)), method="bounded"
    )
    gain = loss(0.0) - float(found.fun)
    return float(np.exp(found.x)) if gain > np.log(residual.size) else 0.0
