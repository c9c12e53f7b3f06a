"""What positions that were held out say of a kernel: how likely they are, and how far it is off there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from udccal.fitting.psf.kernel_error import KernelError, estimate_kernel_error
from udccal.fitting.psf.residual import Sources, Windows, expected
from udccal.fitting.psf.weights import estimate_model_error, huber, noise_at


@dataclass(frozen=True)
class Judged:
    """Samples that a solution has not seen, next to what it expects of them.

    Attributes:
        residual, light: in e-/s.
        measured, variance: of the sensor's noise, as it was measured and at the light expected.
        left_out: what a model error of 1 would add to the standard deviation.
        known: which samples there are.
        model_error: the one under which the residuals are most likely.
    """

    residual: Float[np.ndarray, "shots rows columns"]
    light: Float[np.ndarray, "shots rows columns"]
    measured: Float[np.ndarray, "shots rows columns"]
    variance: Float[np.ndarray, "shots rows columns"]
    left_out: Float[np.ndarray, "shots rows columns"]
    known: Bool[np.ndarray, "shots rows columns"]
    model_error: float

    @property
    def total(self) -> Float[np.ndarray, "shots rows columns"]:
        """Variance with the model error."""
        return self.variance + (self.model_error * self.left_out) ** 2

    def errors(self) -> Float[np.ndarray, " samples"]:
        """Of all samples, in units of their sigma."""
        return (self.residual / np.sqrt(self.total))[self.known]

    def loss(self, position: Int[np.ndarray, " shots"]) -> Float[np.ndarray, " places"]:
        """Minus twice the logarithm of the likelihood per sample, but for a constant, by position.

        Pictures of a position share what the model leaves out there. Of a single position, it is by picture.
        """
        size = np.abs(self.residual) / np.sqrt(self.total)
        each = (np.log(self.total / self.measured) + huber(size)) * self.known
        by_shot = each.sum(axis=(1, 2)) / np.maximum(self.known.sum(axis=(1, 2)), 1)
        places = np.unique(position)
        return np.array([by_shot[position == place].mean() for place in places]) if len(places) > 1 else by_shot


def judge(windows: Windows, share: float, image: Float[np.ndarray, "terms 3 node_rows node_columns"]) -> Judged:
    """Compare the expectation of diffraction (``share`` of it) and image with the data."""
    light = expected(windows, share, image)
    rate, known = np.asarray(windows.rate), np.asarray(windows.weight) > 0
    measured = np.asarray(windows.variance)
    variance = noise_at(light, rate, measured, np.asarray(windows.noise_per_rate))
    # The same for all candidates, and not nothing where one of them expects no light.
    one = np.asarray(windows.left_out)
    model_error = estimate_model_error((rate - light)[known], variance[known], one[known], 0)
    return Judged(rate - light, light, measured, variance, one, known, model_error)


def kernel_error(judged: Judged, windows: Windows, sources: Sources) -> KernelError:
    """How far the kernel is off beside noise, from samples that it has not seen."""
    colour, flux = np.asarray(windows.colour), np.abs(sources.flux)
    unit = judged.light / np.maximum(np.einsum("syxc,sc->syx", colour, flux), 1e-300)
    # Pictures see the peak at different fractions of a pixel: the highest of all is nearest to it.
    peaks = np.maximum((unit[..., None] * colour * judged.known[..., None]).max(axis=(0, 1, 2)), 1e-300)
    full = np.einsum("syxc,sc,c->syx", colour, flux, peaks)
    seen = judged.known & (full > 0)
    full = full[seen]
    return estimate_kernel_error(
        judged.residual[seen] / full, judged.variance[seen] / full**2, judged.light[seen] / full
    )
