"""A scan for the wire far around the rig description: stand-off, pupil and origin by demodulation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.ndimage import maximum_filter
from scipy.special import j1

from udccal.fitting.wire.data import Pixels
from udccal.fitting.wire.jacobian import rays_at, values_at
from udccal.fitting.wire.parameters import shape_sigma
from udccal.fitting.wire.rules import WireRules, WireStart
from udccal.models.wire import Wire


def scan_rows(
    wire: Wire, gains: Float[np.ndarray, " sites"], start: WireStart, pixels: Pixels, rules: WireRules
) -> tuple[list[Wire], float]:
    """Wires whose stand-off, pupil and origin along Y put most signal into the rows' first harmonic, best first.

    There may be several: a pupil one period larger with the origin half a period on has nearly the same harmonic.
    ``wire`` has no modulation and the start's stand-off and pupil; ``pixels`` have its weights. The second result is
    the chi-squared that the best one's first harmonic explains, 0 where there is none.
    """
    rays, sigma = rays_at(wire, pixels.ideal), shape_sigma(start, rules)
    half_field = max(float(np.ptp(rays.periods[1])) / 2, 1.0)
    z = max(np.pi * start.footprint_per_pitch * float(np.sqrt(np.max(rays.ellipse[2]))), 1.0)
    step, step_z = rules.scan_steps
    off = _trials(rules.scan_range, step / half_field, 2500), _trials(rules.scan_range, step_z / z, 80)
    standoffs, pupils = start.standoff_per_pitch * np.exp(off[0]), start.footprint_per_pitch * np.exp(off[1])
    gain, angle = _demodulate(wire, gains, pixels, 1, standoffs, pupils)
    unlikely = (off[0] / sigma[3])[:, None] ** 2 + (off[1] / sigma[6]) ** 2
    score = np.where(gain > 0, gain - np.minimum(unlikely, 0.5 * gain), 0.0)
    # Other places count if they explain a good part of the best one's chi-squared.
    peaks = np.argwhere((maximum_filter(score, size=3, mode="nearest") == score) & (score >= 0.3 * score.max()))
    order = np.argsort([-score[i, j] for i, j in peaks], kind="stable")[: rules.places]
    found = [_placed(wire, standoffs[i], pupils[j], 1, angle[i, j]) for i, j in peaks[order]]
    return found, float(gain[tuple(peaks[order[0]])]) if found else 0.0


def beside(place: Wire) -> list[Wire]:
    """The places with a pupil one period larger or smaller, where the first harmonic's sign and the origin change.

    For a pupil of several periods, a period of diameter is one zero more, or less, in the pupil's transform.
    """
    pupil, standoff = float(place.footprint_per_pitch), float(place.standoff_per_pitch)
    angle = 2 * np.pi * (float(np.asarray(place.offset_periods)[1]) + 0.5)
    return [_placed(place, standoff, size, 1, angle) for size in (pupil - 1.0, pupil + 1.0) if size > 1.0]


def scan_columns(wire: Wire, gains: Float[np.ndarray, " sites"], pixels: Pixels) -> Wire:
    """The wire with the origin along X from the columns' first harmonic; the rows have given the rest."""
    standoff, pupil = float(wire.standoff_per_pitch), float(wire.footprint_per_pitch)
    _gain, angle = _demodulate(wire, gains, pixels, 0, np.array([standoff]), np.array([pupil]))
    return _placed(wire, standoff, pupil, 0, angle[0, 0])


def _trials(ends: tuple[float, float], step: float, most: int) -> Float[np.ndarray, " n"]:
    """Logarithms of the factors to try; one factor is 1, the rig description itself."""
    low, high = np.log(ends)
    count = int(np.clip(np.ceil((high - low) / step), 8, most))
    below = max(round(count * -low / (high - low)), 1)
    return np.concatenate([np.linspace(low, 0, below + 1)[:-1], np.linspace(0, high, count - below + 1)])


def _demodulate(
    wire: Wire,
    gains: Float[np.ndarray, " sites"],
    pixels: Pixels,
    axis: int,
    standoffs: Float[np.ndarray, " s"],
    pupils: Float[np.ndarray, " p"],
) -> tuple[Float[np.ndarray, "s p"], Float[np.ndarray, "s p"]]:
    """Demodulate the residuals of ``wire``: chi-squared by an axis' first harmonic, in residual variances; phase."""
    whole, base = values_at(wire, pixels.ideal, pixels.scaled)
    level = base * gains[pixels.site]
    root = np.sqrt(pixels.weight) * level
    errors = (pixels.value / level - whole) * root
    variance = max(float(np.sum(errors**2)) / max(pixels.used, 1), 1e-300)
    rays = rays_at(wire, pixels.ideal)
    slope = (rays.periods[axis] - np.asarray(wire.offset_periods)[axis]) / float(wire.standoff_per_pitch)
    z = np.pi * pupils[:, None] * np.sqrt(rays.ellipse[2 * axis])
    sizes = root * 2.0 * np.sinc(rays.openings[axis]) * 2.0 * j1(z) / z
    power = np.maximum(np.sum(sizes**2, axis=1), 1e-300)
    # errors = a cos(phase + t) = a (cos t cos(phase) - sin t sin(phase)): the angle found is t.
    phases = (2 * np.pi * standoff * slope for standoff in standoffs)
    sums = np.stack([sizes @ np.stack([errors * np.cos(p), -errors * np.sin(p)], axis=1) for p in phases])
    return 2 * np.sum(sums**2, axis=-1) / power / variance, np.arctan2(sums[..., 1], sums[..., 0])


def _placed(wire: Wire, standoff: float, pupil: float, axis: int, angle: float) -> Wire:
    offset = np.array(wire.offset_periods, dtype=np.float64)
    offset[axis] = float(angle) / (2 * np.pi)
    return replace(
        wire, standoff_per_pitch=np.float64(standoff), footprint_per_pitch=np.float64(pupil), offset_periods=offset
    )
