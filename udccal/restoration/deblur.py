"""Space-varying deblurring of one channel: a regularised least-squares problem, solved by preconditioned conjugate
gradients.

The cost over the canvas is |M (A x - y)|^2 + smoothness |D x|^2. A is the blur in low rank. M leaves out samples
without a value (saturated ones, and all beyond the frame). D takes the differences between neighbours, a 1/f^2 prior
as natural scenes follow. All weights are equal: noise and the contrasts of a scene both grow with the signal, but the
smoothness is their ratio, which does not. Clipped highlights may become as bright as their streaks require.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32

from udccal.restoration.operator import Blur, Canvas

# Keeps the constant part of the problem definite; far below the smoothness.
RIDGE = 1e-5


@dataclass(frozen=True)
class Solution:
    """A deblurred channel over the frame, and how the solver ended.

    ``residual`` is the norm of the preconditioned residual relative to its initial value.
    """

    picture: Float32[np.ndarray, "rows columns"]
    iterations: int
    residual: float


@dataclass(frozen=True)
class Deblurrer:
    """The precomputed parts of one channel's problem; ``solve`` is called per frame.

    ``mean_power`` is the power spectrum of the mean kernel, ``difference_power`` that of D.
    """

    blur: Blur
    mean_power: Float32[np.ndarray, "rows half"]
    difference_power: Float32[np.ndarray, "rows half"]
    iterations: int
    tolerance: float

    @classmethod
    def of(cls, blur: Blur, iterations: int, tolerance: float) -> Deblurrer:
        """Compute the two spectra from which every preconditioner is made."""
        mean = blur.mean_spectrum()
        return cls(blur, mean.real**2 + mean.imag**2, _difference_power(blur.canvas), iterations, tolerance)

    def solve(
        self,
        blurred: Float32[np.ndarray, "rows columns"],
        valid: Bool[np.ndarray, "rows columns"],
        smoothness: float,
    ) -> Solution:
        """Estimate the scene behind a blurred channel.

        Args:
            blurred: the channel over the frame.
            valid: samples that carry data; the scene at the others follows from these.
            smoothness: variance of the noise over the expected mean square of a neighbour difference.
        """
        canvas, blur = self.blur.canvas, self.blur
        penalty = np.float32(smoothness) * self.difference_power + np.float32(RIDGE)
        # The exact inverse if every kernel were the mean kernel and every sample carried data.
        preconditioner = 1.0 / (self.mean_power + penalty)
        weight = np.zeros((canvas.rows, canvas.columns), dtype=np.float32)
        canvas.frame(weight)[:] = valid
        data = canvas.extended(blurred)

        def normal(x: Float32[np.ndarray, "rows columns"]) -> Float32[np.ndarray, "rows columns"]:
            return blur.adjoint(weight * blur.forward(x)) + self._filtered(x, penalty)

        x = self._filtered(blur.adjoint(data), preconditioner)
        known = blur.adjoint(weight * data)
        start = _power(known, self._filtered(known, preconditioner))
        residual = known - normal(x)
        change = self._filtered(residual, preconditioner)
        direction, power = change.copy(), _power(residual, change)
        done = 0
        while done < self.iterations and power > self.tolerance**2 * start:
            applied = normal(direction)
            step = np.float32(power / _power(direction, applied))
            x += step * direction
            residual -= step * applied
            change = self._filtered(residual, preconditioner)
            power, previous = _power(residual, change), power
            direction = change + np.float32(power / previous) * direction
            done += 1
        return Solution(canvas.frame(x).copy(), done, float(np.sqrt(max(power, 0.0) / start)) if start > 0 else 0.0)

    def _filtered(
        self, x: Float32[np.ndarray, "rows columns"], gain: Float32[np.ndarray, "rows half"]
    ) -> Float32[np.ndarray, "rows columns"]:
        spectrum = self.blur.canvas.transform(x)
        spectrum *= gain
        return self.blur.canvas.inverse(spectrum)


def expected_smoothness(blurred: Float32[np.ndarray, "rows columns"], variance: float, contrast: float) -> float:
    """Return the variance of the noise over the expected mean square of a neighbour difference.

    The expected difference is ``contrast`` times the channel's 97th percentile. It is at least a tenth of the noise's
    sigma, so that a frame without light gives a finite value.
    """
    level = contrast * float(np.percentile(blurred, 97.0))
    return variance / max(level, np.sqrt(variance) / 10.0) ** 2


def _difference_power(canvas: Canvas) -> Float32[np.ndarray, "rows half"]:
    """|D|^2: the power of the differences between horizontal and vertical neighbours, by frequency."""
    y = 4.0 * np.sin(np.pi * np.fft.fftfreq(canvas.rows)) ** 2
    x = 4.0 * np.sin(np.pi * np.fft.rfftfreq(canvas.columns)) ** 2
    return (y[:, None] + x[None, :]).astype(np.float32)


def _power(a: Float32[np.ndarray, "rows columns"], b: Float32[np.ndarray, "rows columns"]) -> float:
    return float(np.vdot(a, b))
