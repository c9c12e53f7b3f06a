"""How far the fitted kernel is off beside noise where nothing was captured, as positions that were held out show it.

Whatever is wrong there counts: what the model leaves out, and what its numbers are off by because of that. Relative to
the kernel's peak it is taken as a power of the kernel's size, which flattens off above a knee: near the peak each
picture's own place and light take up part of what is wrong.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
import scipy.optimize
from jaxtyping import Float

# Beyond so many sigma the loss grows with the logarithm alone: of a hit, but where the model is far off counts.
_ROBUST = 5.0
# Means and standard deviations beforehand, of the logarithm of the knee and of the power.
_KNEE, _KNEE_SIGMA, _POWER, _POWER_SIGMA = np.log(0.3), 1.0, 0.75, 0.15
_BOUNDS = ((np.log(1e-5), np.log(2.0)), (np.log(3e-3), np.log(10.0)), (0.3, 1.2))
_STARTS = (1e-3, 1e-2, 1e-1)
_LEAST_SIZE = 1e-7


@final
@dataclass(frozen=True)
class KernelError:
    """Standard deviation of a kernel's samples, where 1 is the kernel's peak: size (s / (1 + s / knee))^power at s.

    A ``size`` of 0 says that nothing was found beside noise.
    """

    size: float
    knee: float
    power: float

    def of_peak(self, brightness: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """Of samples that have this part of their peak's light."""
        part = np.maximum(brightness, 0.0)
        return self.size * (part / (1.0 + part / self.knee)) ** self.power

    def of_kernels(self, kernels: Float[np.ndarray, "*n rows columns"]) -> Float[np.ndarray, "*n rows columns"]:
        """In the kernels' own unit."""
        peak = np.maximum(kernels.max(axis=(-2, -1), keepdims=True), 1e-300)
        return self.of_peak(kernels / peak) * peak

    def relative_l2(self, kernels: Float[np.ndarray, "*n rows columns"]) -> Float[np.ndarray, "*n"]:
        """What that makes of a whole kernel."""
        square = (kernels**2).sum(axis=(-2, -1))
        return np.asarray(np.sqrt((self.of_kernels(kernels) ** 2).sum(axis=(-2, -1)) / np.maximum(square, 1e-300)))


NONE = KernelError(0.0, 1.0, _POWER)


def estimate_kernel_error(
    residual: Float[np.ndarray, " samples"],
    variance: Float[np.ndarray, " samples"],
    brightness: Float[np.ndarray, " samples"],
) -> KernelError:
    """The error of greatest posterior; ``NONE`` where noise alone explains the residuals as well, by BIC.

    Args:
        residual: data less expectation at positions that were held out, as a part of the peak's light.
        variance: of the sensor's noise, in the same unit.
        brightness: expected light as a part of the peak's.
    """
    seen = brightness > _LEAST_SIZE
    residual, variance, brightness = residual[seen], variance[seen], brightness[seen]
    if residual.size < len(_BOUNDS):
        return NONE

    def loss(values: Float[np.ndarray, "3"]) -> float:
        strain = ((values[1] - _KNEE) / _KNEE_SIGMA) ** 2 + ((values[2] - _POWER) / _POWER_SIGMA) ** 2
        return _misfit(residual, variance + _error(values).of_peak(brightness) ** 2) + float(strain)

    found = min(
        (
            scipy.optimize.minimize(loss, (np.log(start), _KNEE, _POWER), method="L-BFGS-B", bounds=_BOUNDS)
            for start in _STARTS
        ),
        key=lambda tried: float(tried.fun),
    )
    gain = _misfit(residual, variance) - float(found.fun)
    return _error(found.x) if gain > len(_BOUNDS) * np.log(residual.size) else NONE


def _error(values: Float[np.ndarray, "3"]) -> KernelError:
    return KernelError(float(np.exp(values[0])), float(np.exp(values[1])), float(values[2]))


def _misfit(residual: Float[np.ndarray, " samples"], variance: Float[np.ndarray, " samples"]) -> float:
    square = residual**2 / (variance * _ROBUST**2)
    return float(
        np.sum(np.log(variance) + _ROBUST**2 * np.where(square < 1, square, 1 + np.log(np.maximum(square, 1))))
    )
