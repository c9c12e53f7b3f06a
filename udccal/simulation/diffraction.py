"""Far-field diffraction by the part of the panel that the pupil looks through, independent of wavelength.

The field over the panel plane is footprint x row mask x column mask. Its power spectrum over the spatial frequency nu
(cycles/mm) is the light sent from direction cosines l0 to l0 + lambda * nu, for every wavelength lambda alike (Goodman,
Introduction to Fourier Optics, section 3.10). It includes conical diffraction, because direction cosines are exact.

The periodic masks are built from their Fourier series cut off at the sampling limit, so that diffraction orders do not
alias. The strength of the orders falls too slowly for a mask drawn by area coverage.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.fft
from jaxtyping import Float, Float32

from udccal.simulation.panel import column_open_interval, pupil_footprint, row_open_interval
from udccal.simulation.truth import RigTruth

# The power spectrum is the transform of an autocorrelation, twice as wide as the footprint: a padding of 2 samples it
# fully, and 3 well enough for cubic interpolation between samples.
_PADDING = 3.0
_HEADROOM = 1.1
_ROWS_BELOW_ZERO = 4
_WORKERS = 2


@dataclass(frozen=True)
class PowerSpectrum:
    """Cumulative power over frequency, as a fraction of all light that passes the mask.

    The power is even in nu; the half with nu_y >= 0 is kept, and a few rows more. ``cumulative[k, m]`` is the power of
    the samples before row k and column m, that is below nu_y = (k - zero_y) * step_y and nu_x = (m - zero_x) * step_x.
    """

    cumulative: Float[np.ndarray, "rows columns"]
    step_y: float
    step_x: float
    zero_y: float
    zero_x: float
    open_area_mm2: float


def power_spectrum(
    truth: RigTruth,
    direction: Float[np.ndarray, "3"],
    limit: tuple[float, float],
    shifts: tuple[tuple[float, float], ...] = ((0.0, 0.0),),
) -> PowerSpectrum:
    """Compute the power spectrum of the part of the panel that the pupil sees along a direction.

    Args:
        truth: the simulated rig.
        direction: unit vector to the source in panel coordinates.
        limit: largest (nu_x, nu_y) needed, in cycles/mm.
        shifts: shifts of the masks in fractions (of a column, of a row), over which the power is averaged.
    """
    centre, shape = pupil_footprint(truth, direction)
    half = np.linalg.norm(shape, axis=1)
    step = 0.5 / (_HEADROOM * np.asarray(limit))
    count_x, count_y = (scipy.fft.next_fast_len(int(n)) for n in np.ceil(_PADDING * 2 * half / step))
    x, y = (_samples(float(centre[i]), float(half[i]), float(step[i])) for i in range(2))
    footprint = ellipse_cover(x - centre[0], y - centre[1], shape, step)
    slopes = direction[:2] / direction[2]
    open_x, open_y = column_open_interval(truth, slopes[:1]), row_open_interval(truth, slopes[1:])
    power = np.zeros((count_y // 2 + 1, count_x), np.float32)
    area = 0.0
    for shift_x, shift_y in shifts:
        columns = _open_mask(x, open_x, shift_x, float(step[0]), truth.panel.pitch_mm)
        rows = _open_mask(y, open_y, shift_y, float(step[1]), truth.panel.pitch_mm)
        field = footprint * rows[:, None] * columns
        half_spectrum = scipy.fft.rfft(field, n=count_y, axis=0, workers=_WORKERS)
        spectrum = scipy.fft.fft(half_spectrum, n=count_x, axis=1, workers=_WORKERS)
        zero = float(spectrum[0, 0].real)
        # By Parseval's theorem a mask of zeros and ones has the total power |F(0)| per cell.
        power += (spectrum.real**2 + spectrum.imag**2) / np.float32(zero * count_x * count_y * len(shifts))
        area += zero * float(step[0] * step[1]) / len(shifts)
    return PowerSpectrum(
        cumulative=_cumulative(power),
        step_y=float(1.0 / (count_y * step[1])),
        step_x=float(1.0 / (count_x * step[0])),
        zero_y=_ROWS_BELOW_ZERO + 0.5,
        zero_x=count_x // 2 + 0.5,
        open_area_mm2=area,
    )


def _cumulative(power: Float32[np.ndarray, "rows columns"]) -> Float[np.ndarray, "nodes_y nodes_x"]:
    """Return running sums along both axes, from a few rows below zero and from the most negative column."""
    below = np.roll(power[_ROWS_BELOW_ZERO:0:-1, ::-1], 1, axis=1)
    centred = scipy.fft.fftshift(np.concatenate([below, power]), axes=1)
    total = np.zeros((centred.shape[0] + 1, centred.shape[1] + 1))
    # Row by row: a running sum down the columns reads memory with large strides and takes twenty times as long.
    for before, row, after in zip(total[:-1, 1:], centred, total[1:, 1:], strict=True):
        np.add(before, row, out=after)
    np.cumsum(total[:, 1:], axis=1, out=total[:, 1:])
    return total


def _samples(centre: float, half: float, step: float) -> Float[np.ndarray, "n"]:
    reach = int(np.ceil(half / step)) + 1
    return centre + step * np.arange(-reach, reach + 1)


def ellipse_cover(
    x: Float[np.ndarray, "columns"],
    y: Float[np.ndarray, "rows"],
    shape: Float[np.ndarray, "2 2"],
    step: Float[np.ndarray, "2"],
) -> Float32[np.ndarray, "rows columns"]:
    """Draw the ellipse ``shape @ u``, |u| <= 1; samples on its edge have their covered fraction."""
    inverse = np.linalg.inv(shape).astype(np.float32)
    x, y = x.astype(np.float32), y.astype(np.float32)
    u = inverse[0, 0] * x + inverse[0, 1] * y[:, None]
    v = inverse[1, 0] * x + inverse[1, 1] * y[:, None]
    radius = np.maximum(np.sqrt(u * u + v * v), np.float32(1e-9))
    slope_x = (u * inverse[0, 0] + v * inverse[1, 0]) / radius
    slope_y = (u * inverse[0, 1] + v * inverse[1, 1]) / radius
    cell = np.abs(slope_x) * np.float32(step[0]) + np.abs(slope_y) * np.float32(step[1])
    return np.clip(0.5 - (radius - 1) / np.maximum(cell, np.float32(1e-12)), 0, 1)


def _open_mask(
    position_mm: Float[np.ndarray, "n"],
    interval: tuple[Float[np.ndarray, "1"], Float[np.ndarray, "1"]],
    shift: float,
    step_mm: float,
    pitch_mm: float,
) -> Float32[np.ndarray, "n"]:
    """Return 1 in the open part of each pitch and 0 elsewhere, as a Fourier series up to the sampling limit."""
    start, width = float(interval[0][0]), float(interval[1][0])
    orders = np.arange(1, int(pitch_mm / (2 * step_mm)) + 1)
    phase = 2 * np.pi * (position_mm / pitch_mm - shift - start - width / 2)
    strength = 2 * np.sin(np.pi * orders * width) / (np.pi * orders)
    return (width + np.cos(phase[:, None] * orders) @ strength).astype(np.float32)
