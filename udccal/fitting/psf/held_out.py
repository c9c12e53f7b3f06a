"""What samples that a solution has not used show of a kernel: its error, and how far its light reaches.

The kernel's error includes the model's deviation from the truth, and the errors of its parameters that follow from it.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import final

import numpy as np
import scipy.optimize
from jaxtyping import Bool, Float, Int

from udccal.fitting.engine.orders import Attempt, Choice, bic, choose
from udccal.fitting.psf.data import HUBER, Crops, Each, PsfRules, Shots, about_middle, estimate_model_error, noise_at
from udccal.fitting.psf.image import Magnitude, Sources, Windows, make_windows
from udccal.kernels import kernel_size, kernels_at
from udccal.models.fields import polynomial_basis
from udccal.models.psf import PsfField
from udccal.result import FitResult
from udccal.rig import RigDescription

# The diagnostics that state the sigma of a kernel's samples begin so; the fields of ``KernelError`` follow.
STATED = "kernel_sigma_"
# (Rows, columns) to either side of the source, of all that were tried up to those that pictures hold.
Support = tuple[Choice[int], Choice[int]]


@final
@dataclass(frozen=True)
class Compared:
    """Samples that a solution has not used, and its expectation of them.

    Attributes:
        residual, light: in e-/s.
        measured, variance: variance of the sensor's noise, as measured, and at the expected light.
        left_out: standard deviation that a model error of 1 would add.
        known: True for samples that were measured.
        channel: each sample's colour; flux: the LED's light in that colour, in e-/s.
        model_error: the one of greatest likelihood for the residuals.
    """

    residual: Crops
    light: Crops
    measured: Crops
    variance: Crops
    left_out: Crops
    known: Bool[np.ndarray, "shots rows columns"]
    channel: Int[np.ndarray, "shots rows columns"]
    flux: Crops
    model_error: float

    @property
    def total(self) -> Crops:
        """Variance of samples, with the model error."""
        return self.variance + (self.model_error * self.left_out) ** 2

    def relative_l2(self) -> Float[np.ndarray, "3"]:
        """Return the expectation's error by colour, which includes the data's own noise."""
        channel = self.channel[self.known]
        error, light = (np.bincount(channel, part[self.known] ** 2, 3) for part in (self.residual, self.light))
        return np.sqrt(error / np.maximum(light, 1e-30))

    def loss(self, position: Int[np.ndarray, " shots"]) -> Float[np.ndarray, " places"]:
        """Return minus twice the log likelihood per sample, up to a constant, by position.

        The model's deviation is common to the pictures of a position. For a single position, the loss is by picture.
        """
        each = (np.log(self.total / self.measured) + HUBER.loss(self.residual / np.sqrt(self.total))) * self.known
        by_shot = each.sum(axis=(1, 2)) / np.maximum(self.known.sum(axis=(1, 2)), 1)
        places = np.unique(position)
        return np.array([by_shot[position == place].mean() for place in places]) if len(places) > 1 else by_shot


def compare(shots: Shots, windows: Windows, light: Crops) -> Compared:
    """Compare the shots with the ``light`` (e-/s) that is expected of them."""
    known, residual = shots.weight > 0, windows.rate - light
    measured = 1.0 / np.where(known, shots.weight, 1.0)
    variance = noise_at(light, windows.rate, measured, shots.noise_per_rate)
    # All orders have the same deviation here; it is above 0 where one of them expects no light.
    unit, channel, flux = windows.left_out, windows.channel, windows.flux
    model_error = estimate_model_error(residual[known], variance[known], unit[known], 0)
    return Compared(residual, light, measured, variance, unit, known, channel, flux, model_error)


@final
@dataclass(frozen=True)
class KernelError:
    """Standard deviation of a kernel's samples, where 1 is the kernel's peak: size (s / (1 + s / knee))^power at s.

    This power of the kernel's value becomes flat above a knee: near the peak, each picture's own place absorbs part of
    the error. A ``size`` of 0 means that nothing was found in addition to noise.
    """

    size: float
    knee: float = 1.0
    power: float = 1.0

    def of_peak(self, brightness: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """Return the sigma of samples with this part of their peak's light."""
        part = np.maximum(brightness, 0.0)
        return self.size * (part / (1.0 + part / self.knee)) ** self.power

    def of_kernels(self, kernels: Float[np.ndarray, "*n rows columns"]) -> Float[np.ndarray, "*n rows columns"]:
        """Return the sigma of every sample of the kernels, in their own unit."""
        peak = np.maximum(kernels.max(axis=(-2, -1), keepdims=True), 1e-300)
        return self.of_peak(kernels / peak) * peak

    def relative_l2(self, kernels: Float[np.ndarray, "*n rows columns"]) -> Float[np.ndarray, "*n"]:
        """Return the relative L2 error of whole kernels."""
        error, light = ((part**2).sum(axis=(-2, -1)) for part in (self.of_kernels(kernels), kernels))
        return np.asarray(np.sqrt(error / np.maximum(light, 1e-300)))

    def relative_rms(self, kernels: Float[np.ndarray, "*n rows columns"]) -> float:
        """Return the RMS of the relative error of all samples that are brighter than 1e-4 of their kernel's peak."""
        seen = kernels > 1e-4 * kernels.max(axis=(-2, -1), keepdims=True)
        return float(np.sqrt(np.mean((self.of_kernels(kernels)[seen] / kernels[seen]) ** 2)))


def estimate_kernel_error(
    residual: Each, variance: Each, brightness: Each, picture: Int[np.ndarray, " samples"], rules: PsfRules
) -> KernelError:
    """Return the most probable error, or a size of 0 where BIC prefers noise alone.

    All arrays are relative to the peak's light: data less expectation, noise's variance, and expected light. Samples of
    one ``picture``, by number, have a light of their own, from unweighted least squares. It follows the errors of the
    brightest samples, so that residuals hide them: each residual is an error less its part along the light. All sizes
    of light count alike: most samples by far are so faint that a kernel's error does not depend on them.
    """
    seen = brightness > 1e-7
    residual, variance, brightness, picture = residual[seen], variance[seen], brightness[seen], picture[seen]
    bounds = ((np.log(1e-5), np.log(2.0)), (np.log(3e-3), np.log(10.0)), (0.3, 1.2))
    if residual.size < len(bounds):
        return KernelError(0.0)
    along = brightness**2 / np.maximum(np.bincount(picture, brightness**2), 1e-300)[picture]
    alone = np.maximum(1 - along, 1e-3) ** 2 - along**2
    level = np.unique(np.floor(np.log(brightness) / np.log(3.0)), return_inverse=True)[1].reshape(-1)
    weight = np.minimum(rules.error_samples / np.bincount(level), 1.0)[level]
    mean, sigma = np.array([(np.log(rules.error_knee[0]), rules.error_knee[1]), rules.error_power]).T

    # A symmetric matrix makes variances of residuals of those of samples.
    def of_residuals(samples: Each) -> Each:
        return np.asarray(alone * samples + along * np.bincount(picture, along * samples)[picture])

    def misfit(variance: Each) -> tuple[float, Each]:
        """Return the cost of these variances, and its derivatives by them."""
        total = of_residuals(variance)
        # Beyond 5 sigma the loss grows as a logarithm: a cosmic hit counts little, a large model error still counts.
        square = residual**2 / (total * 25.0)
        each = np.log(total) + 25.0 * np.where(square < 1, square, 1 + np.log(np.maximum(square, 1)))
        return float(weight @ each), of_residuals(weight * (1 - 25.0 * np.minimum(square, 1)) / total)

    def of(size: float, knee: float, power: float) -> KernelError:
        return KernelError(float(np.exp(size)), float(np.exp(knee)), float(power))

    def loss(values: Float[np.ndarray, "3"]) -> tuple[float, Float[np.ndarray, "3"]]:
        error, bend = of(*values).of_peak(brightness), brightness / np.exp(values[1])
        cost, slope = misfit(variance + error**2)
        off = (values[1:] - mean) / sigma
        by = np.stack([np.ones_like(bend), values[2] * bend / (1 + bend), np.log(brightness / (1 + bend))])
        return cost + float(off @ off), 2 * by @ (error**2 * slope) + np.append(0.0, 2 * off / sigma)

    # The default tolerance leaves a part in a hundred of the size open.
    options = {"method": "L-BFGS-B", "jac": True, "bounds": bounds, "options": {"ftol": 1e-13}}
    tried = [scipy.optimize.minimize(loss, (np.log(size), *mean), **options) for size in (1e-3, 1e-2, 1e-1)]
    found = min(tried, key=lambda one: float(one.fun))
    worth = bic(float(found.fun), float(len(bounds)), round(weight.sum())) < misfit(variance)[0]
    return of(*found.x) if worth else KernelError(0.0)


def kernel_error(found: Compared, rules: PsfRules) -> KernelError:
    """Estimate the kernel's error without noise, from samples that it has not used."""
    flux, channel = np.abs(found.flux), found.channel
    unit = found.light / np.maximum(flux, 1e-300) * found.known
    # Pictures sample the peak at different fractions of a pixel: the largest sample is nearest to it.
    full = flux * np.array([unit[channel == colour].max(initial=1e-300) for colour in range(3)])[channel]
    seen = found.known & (full > 0)
    full, picture = full[seen], (3 * np.arange(len(channel))[:, None, None] + channel)[seen]
    residual, variance, light = found.residual[seen] / full, found.variance[seen] / full**2, found.light[seen] / full
    return estimate_kernel_error(residual, variance, light, picture, rules)


def stated_error(error: KernelError, by_parameters: float, magnitude: Magnitude, rules: PsfRules) -> KernelError:
    """Return the sigma of a kernel's samples by all that the fit states of it, in the shape of the held-out error.

    That error, which may be 0, holds the parameters' errors at positions held out, and so has their shape.
    ``by_parameters`` is the kernel's relative L2 sigma by their covariance, ``magnitude`` its average size.
    """
    shape = error if error.size else KernelError(1.0, rules.error_knee[0], rules.error_power[0])
    unit = float(shape.relative_l2(magnitude).mean()) / shape.size
    return replace(shape, size=float(np.hypot(error.relative_l2(magnitude).mean(), by_parameters)) / max(unit, 1e-300))


def stated_by(result: FitResult[PsfField]) -> KernelError | None:
    """Return the same of a result, or of a profile's; None where the fit does not state it."""
    found = [result.diagnostic(STATED + field.name) for field in fields(KernelError)]
    stated = [value for value in found if value is not None]
    return KernelError(*stated) if len(stated) == len(found) else None


def error_patterns(
    term: PsfField, error: KernelError, rig: RigDescription, patterns: int
) -> tuple[int, Float[np.ndarray, "terms 3 rows columns"], Float[np.ndarray, "patterns 3 rows columns"]]:
    """Return a degree, the size of the kernel's error as polynomials of that degree of the position, and signs.

    Four places along each axis determine cubic polynomials.
    """
    along = np.stack(np.meshgrid(*2 * (np.linspace(-0.9, 0.9, 4),)), axis=-1).reshape(-1, 2)
    places, degree = np.asarray(term.centre_px) + along * np.asarray(term.half_px), max(3, term.degree)
    rows, columns = (max(pair) for pair in zip(kernel_size(rig), term.residual.shape[2:], strict=True))
    sizes = error.of_kernels(kernels_at(term, places, rows, columns).astype(np.float64))
    basis = np.asarray(polynomial_basis(along, degree), dtype=np.float64)
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (patterns, *sizes.shape[1:]))
    return degree, np.tensordot(np.linalg.pinv(basis), sizes, axes=1), signs


def choose_support(found: Compared) -> Support:
    """Choose the smallest window outside of which samples that the model has not used show none of the kernel's light.

    Rows and columns have a window each, since a kernel of pixel rows is a cross. The candidate is the model's kernel
    inside the window, and an even background outside. The criterion is BIC, with one more parameter for every larger
    window: real light lowers chi-squared by many times that, and light that only the model has does not.
    """
    rows, columns = (size // 2 for size in found.residual.shape[1:])
    y, x = np.abs(np.mgrid[-rows : rows + 1, -columns : columns + 1])
    return _along(found, "rows", y), _along(found, "columns", x)


def windows_to_try(largest_px: int) -> tuple[int, ...]:
    """Return sizes to either side from 4 px up to the largest, each about sqrt(2) times the one before."""
    count = int(np.ceil(2.0 * np.log2(max(largest_px / 4.0, 1.0))))
    steps = np.round(4.0 * 2.0 ** (np.arange(count) / 2.0)).astype(int)
    return (*(int(step) for step in steps if step < largest_px), largest_px)


def _along(found: Compared, name: str, distance: Int[np.ndarray, "rows columns"]) -> Choice[int]:
    """Compare the windows along one axis; each picture's background is fitted again for each window."""
    weight, samples = np.where(found.known, 1.0 / found.total, 0.0), int(found.known.sum())
    tried = []
    for step, half in enumerate(windows_to_try(int(distance.max()))):
        error = found.residual + found.light * (distance > half)
        background = (weight * error).sum(axis=(1, 2)) / np.maximum(weight.sum(axis=(1, 2)), 1e-300)
        loss = float(HUBER.loss((error - background[:, None, None]) * np.sqrt(weight)).sum())
        tried.append(Attempt(f"{name}: light within {half} px", step, bic(loss, float(step), samples), half))
    return choose(tried)


def wide_support(wide: Shots, sources: Sources, term: PsfField, rig: RigDescription) -> Support:
    """Choose the support from whole pictures of positions held out, whose places and light are ``sources``."""
    # The size that a profile holds needs no second compilation.
    rows, columns = kernel_size(rig)
    wide = wide.within((rows // 2, columns // 2))
    kernels = about_middle(kernels_at(term, wide.positions_px(), rows, columns).astype(np.float64), wide.half)
    at_position = np.eye(wide.positions)[wide.position]
    windows = make_windows(wide, sources, np.zeros_like(wide.rate), at_position, 0.0)
    light = windows.unit_light(kernels)
    windows = make_windows(wide, sources.with_light_of_peak(wide, light), light, at_position, 0.0)
    found = compare(wide, windows, light * windows.flux)
    # Near the source, whole pixels are too coarse for a kernel that moves by fractions of one; all windows hold it.
    core = (np.abs(wide.offsets()) <= 4).all(axis=-1)
    return choose_support(replace(found, known=found.known & ~core))


def with_support(term: PsfField, support: Support, rig: RigDescription) -> tuple[PsfField, tuple[str, ...]]:
    """Return the term with this support of its kernel, and the notes for axes along which no end of it was seen.

    Diffraction reaches over the whole sensor where light reaches the end of the pictures; an image ends at the support.
    """
    down, across = (one.best is one.tried[-1] and bool(term.diffraction_fraction) for one in support)
    rows, columns = (one.best.fit for one in support)
    half_px = [rig.camera.columns if across else columns, rig.camera.rows if down else rows]
    term = replace(term, support_px=np.array(half_px, dtype=np.float64))
    if not (down or across):
        return term, ()
    along = " and ".join(["columns"] * down + ["rows"] * across)
    seen = "light was seen as far as was looked; beyond, the kernel is diffraction as fitted."
    return term, (f"Along {along} {seen}",)
