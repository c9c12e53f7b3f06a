"""Patterns of dark frames: a level that does not follow its line over exposures, and parts of the sensor that differ.

A profile has one black level and one dark current for the whole sensor. A restoration takes what deviates for light.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float, Float32

from udccal.fitting.engine.robust import OutlierRule, robust_sigma
from udccal.fitting.noise.frame_moments import Moments
from udccal.fitting.noise.moments import NoiseMoments
from udccal.models.noise import Noise, linear_signal
from udccal.validation.checks import Check
from udccal.validation.limits import ValidationLimits
from udccal.validation.patterns import Pattern, bands, pattern_check, scatter_pattern

# Bands of rows and of columns, and parts of the sensor a side.
_BANDS, _PARTS = 16, 8
_DEFECTS = OutlierRule("pixels of the dark frames")


def bend_check(seen: NoiseMoments, term: Noise, limits: ValidationLimits) -> Check:
    """Whether the dark frames' level follows a line over exposures; the line itself is judged elsewhere."""
    return pattern_check(
        "noise",
        "dark level over exposures",
        [_bend(seen.dark_moments, term)],
        1 / _dark_noise_DN(term),
        limits.dark_sigma_d,
        "σ_d",
        "Levels of dark frames about a line over exposures",
    )


def _bend(darks: tuple[Moments, ...], term: Noise) -> Pattern:
    """Test the levels about their best line by how much frames of one exposure differ; squares in DN^2."""
    black, K = (float(np.asarray(part)) for part in (term.black_DN, term.K_DN_per_e))
    exposure = np.concatenate([np.full(one.frames, one.exposure_s) for one in darks])
    frames = np.concatenate([_frame_means(one) for one in darks])
    level = np.asarray(linear_signal(frames - black, float(np.asarray(term.bend_per_DN)), K))
    # Rows are independent, and their means scatter by the noise of rows and of samples.
    variance = np.concatenate([np.full(one.frames, one.rows.variance_DN2 / one.height) for one in darks])
    sigma = np.sqrt(np.maximum(variance, 1e-12))
    times, number = np.unique(exposure, return_inverse=True)
    inside = np.eye(len(times))[number] / sigma[:, None]
    line = np.column_stack([np.ones_like(exposure), exposure]) / sigma[:, None]
    off, within = (_left(columns, level / sigma) for columns in (line, inside))
    total, weight = float(off @ off), float(np.sum(sigma**-2))
    return Pattern.by_scatter(total - float(within @ within), total, len(times) - 2, len(level) - 2, weight)


def _left(columns: Float[np.ndarray, "n k"], values: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """What the best combination of columns leaves of values."""
    return np.asarray(values - columns @ np.linalg.lstsq(columns, values, rcond=None)[0])


def _frame_means(one: Moments) -> Float[np.ndarray, " frames"]:
    """Mean of each frame in DN."""
    return np.asarray(one.level_DN + np.average(one.shift_DN, axis=1, weights=one.samples))


def dark_pattern_check(seen: NoiseMoments, term: Noise, limits: ValidationLimits) -> Check:
    """Whether bands of rows, bands of columns or parts of the sensor are darker or brighter than the others.

    The profile states the scatter of all pixels' offsets (DSNU), patterns included: one as large as that is expected.
    """
    noise = _dark_noise_DN(term)
    of_pixels = float(np.asarray(term.DSNU1288_e)) * float(np.asarray(term.K_DN_per_e)) / noise
    return pattern_check(
        "noise",
        "dark level over the sensor",
        _patterns(seen.dark_stack.mean_DN),
        1 / noise,
        max(limits.dark_sigma_d, of_pixels),
        "σ_d",
        "Bands of rows, bands of columns and parts of the averaged dark frame",
    )


def _patterns(dark_DN: Float32[np.ndarray, "rows columns"]) -> tuple[Pattern, ...]:
    """Patterns of an averaged dark frame; squares in DN^2. Rows have noise in common, which their bands have not."""
    about = np.ascontiguousarray(dark_DN - np.median(dark_DN), dtype=np.float32)
    # A defect is unlike its neighbours; a corner that glows is not.
    nearby = cv2.medianBlur(about, 5)
    off = about - nearby
    bad = _DEFECTS.off(off / (robust_sigma(off) or float(off.std()) or 1.0))
    about = np.where(bad, nearby, about).astype(np.float64)
    rows, columns = about.mean(axis=1), about.mean(axis=0)
    plain = about - rows[:, None] - columns + about.mean()
    down, across = (bands(size, _PARTS) for size in about.shape)
    part = (down[:, None] * (across.max() + 1) + across).ravel()
    by_line = (scatter_pattern(line, bands(len(line), _BANDS)) for line in (rows, columns))
    return (*by_line, scatter_pattern(plain.ravel(), part))


def _dark_noise_DN(term: Noise) -> float:
    """Dark noise of one sample."""
    return max(float(np.asarray(term.sigma_d_e)) * float(np.asarray(term.K_DN_per_e)), 1e-9)
