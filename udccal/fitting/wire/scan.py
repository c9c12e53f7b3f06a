"""Where the wire may be: stand-off, pupil and origin that demodulate a flat best, far around the rig description."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float
from scipy.ndimage import maximum_filter

from udccal.fitting.wire.basis import Pixels, residuals_and_base
from udccal.fitting.wire.harmonics import FIELD_DEGREES, SMOOTH_DEGREE, WireStart
from udccal.fitting.wire.prior import Prior
from udccal.models.geometry import Geometry
from udccal.models.wire import Wire, carriers, kappa, modulation, slopes, waves

# Stand-off in periods and pupil in periods, relative to the rig description: twenty per cent wrong in each of two
# lengths that are divided is a factor 1.5.
_STANDOFFS, _PUPILS = (0.64, 1.56), (0.64, 1.56)
# Between trials: periods at the edge of the field; radians of z, the argument of the pupil's transform.
_PERIOD_STEP, _Z_STEP = 0.06, 0.8
_MOST_STANDOFFS, _MOST_PUPILS = 2500, 80
# Other places are looked into that explain at least this share of what the best does; so many at most.
_SHARE, _MOST_PLACES = 0.3, 5


@final
@dataclass(frozen=True)
class Place:
    """A wire as demodulation finds it, and the chi-squared that its first harmonic explains."""

    wire: Wire
    gain: float


_kappa = jax.jit(lambda wire, ideal: kappa(wire, slopes(wire, ideal)))
_slopes = jax.jit(slopes)
modulation_at = jax.jit(lambda wire, ideal, scaled: modulation(wire, slopes(wire, ideal), scaled))
_carrier = jax.jit(lambda wire, ideal: carriers(wire, slopes(wire, ideal), kappa(wire, slopes(wire, ideal)))[0, 0])
_wave = jax.jit(lambda wire, ideal: waves(wire, slopes(wire, ideal))[:, 0])


def ideal_wire(geometry: Geometry, start: WireStart, harmonics: Float[np.ndarray, "harmonics 2"]) -> Wire:
    """The rig as built, with a round pupil."""
    fields = np.zeros((len(harmonics), 2, 2, FIELD_DEGREES))
    fields[:, 0, 0, 0] = 1.0
    return Wire(
        geometry=geometry,
        rotation=np.zeros(3),
        standoff_per_pitch=np.float64(start.standoff_per_pitch),
        offset=np.zeros(2),
        pupil_per_pitch=np.float64(start.pupil_per_pitch),
        row_open=np.float64(start.row_open),
        column_open=np.float64(start.column_open),
        depth_per_pitch=np.float64(start.depth_per_pitch),
        harmonics=harmonics,
        frequency=np.tile([0.0, 1.0], (len(harmonics), 1)),
        fields=fields,
        amplitudes=np.zeros((0, 2, 1, 1)),
        baseline=np.zeros((SMOOTH_DEGREE + 1, SMOOTH_DEGREE + 1)),
    )


def with_harmonics(wire: Wire, harmonics: Float[np.ndarray, "harmonics 2"], pixels: Pixels) -> Wire:
    """The same shape with other harmonics of a round pupil, and their ranges of kappa over the sample."""
    fields = np.zeros((len(harmonics), 2, 2, FIELD_DEGREES))
    fields[:, 0, 0, 0] = 1.0
    unknown = np.tile([0.0, 1.0], (len(harmonics), 1))
    wire = eqx.tree_at(lambda w: (w.harmonics, w.frequency, w.fields), wire, (harmonics, unknown, fields))
    seen = np.asarray(_kappa(wire, pixels.ideal[:: max(1, len(pixels.ideal) // 2048)][:2048]))
    low, high = seen.min(axis=1), seen.max(axis=1)
    frequency = np.stack([(low + high) / 2, np.maximum(0.51 * (high - low), 0.01)], axis=1)
    return eqx.tree_at(lambda w: w.frequency, wire, frequency)


def scan_rows(wire: Wire, gains: Float[np.ndarray, "4"], start: WireStart, prior: Prior, pixels: Pixels) -> list[Place]:
    """Stand-offs, pupils and origins along Y that put most of the signal into the rows' first harmonic, best first.

    There may be several: a pupil one period larger with the origin half a period on has nearly the same harmonic.
    """
    wire = with_harmonics(wire, np.array([[0.0, 1.0]]), pixels)
    slope = np.asarray(_slopes(wire, pixels.ideal))[1]
    half_field = max(start.standoff_per_pitch * float(np.ptp(slope)) / 2, 1.0)
    standoffs = start.standoff_per_pitch * _ladder(_STANDOFFS, _PERIOD_STEP / half_field, _MOST_STANDOFFS)
    z = np.pi * start.pupil_per_pitch * float(np.max(np.asarray(_kappa(wire, pixels.ideal[:2048]))))
    pupils = start.pupil_per_pitch * _ladder(_PUPILS, _Z_STEP / max(z, 1.0), _MOST_PUPILS)
    gain, angle = _demodulate(_without(wire), wire, gains, pixels, standoffs, pupils)
    unlikely = ((np.log(standoffs) - prior.centre[3]) / prior.sigma[3])[:, None] ** 2
    unlikely = unlikely + ((np.log(pupils) - prior.centre[6]) / prior.sigma[6]) ** 2
    score = np.where(gain > 0, gain - np.minimum(unlikely, 0.5 * gain), 0.0)
    peaks = np.argwhere((maximum_filter(score, size=3, mode="nearest") == score) & (score >= _SHARE * score.max()))
    order = np.argsort([-score[i, j] for i, j in peaks], kind="stable")[:_MOST_PLACES]
    return [
        Place(_placed(wire, standoffs[i], pupils[j], 1, angle[i, j]), float(gain[i, j]))
        for i, j in (tuple(peaks[k]) for k in order)
    ]


def beside(place: Place) -> list[Place]:
    """The places with a pupil one period larger or smaller: the first harmonic's sign changes, and with it the origin.

    In the pupil's transform a period of diameter is one zero more, or less, for a pupil of several periods.
    """
    found = []
    for step in (-1.0, 1.0):
        pupil = float(place.wire.pupil_per_pitch) + step
        if pupil > 1.0:
            angle = 2 * np.pi * (float(np.asarray(place.wire.offset)[1]) + 0.5)
            standoff = float(place.wire.standoff_per_pitch)
            found.append(Place(_placed(place.wire, standoff, pupil, 1, angle), place.gain))
    return found


def scan_columns(wire: Wire, gains: Float[np.ndarray, "4"], pixels: Pixels) -> Wire:
    """The origin along X from the columns' first harmonic; the rest is known from the rows."""
    alone = with_harmonics(wire, np.array([[1.0, 0.0]]), pixels)
    known = np.array([float(wire.standoff_per_pitch)]), np.array([float(wire.pupil_per_pitch)])
    _gain, angle = _demodulate(wire, alone, gains, pixels, *known)
    return _placed(wire, known[0][0], known[1][0], 0, angle[0, 0])


def _ladder(ends: tuple[float, float], step: float, most: int) -> Float[np.ndarray, " n"]:
    low, high = np.log(ends)
    count = int(np.clip(np.ceil((high - low) / step), 8, most))
    # One of the steps is the rig description itself.
    below = max(round(count * -low / (high - low)), 1)
    return np.exp(np.concatenate([np.linspace(low, 0, below + 1)[:-1], np.linspace(0, high, count - below + 1)]))


def _without(wire: Wire) -> Wire:
    return eqx.tree_at(lambda w: w.fields, wire, np.zeros_like(wire.fields))


def _demodulate(
    explained: Wire,
    wire: Wire,
    gains: Float[np.ndarray, "4"],
    pixels: Pixels,
    standoffs: Float[np.ndarray, " s"],
    pupils: Float[np.ndarray, " p"],
) -> tuple[Float[np.ndarray, "s p"], Float[np.ndarray, "s p"]]:
    """Of what ``explained`` leaves: chi-squared by the only harmonic of ``wire``, in residual variances; its phase."""
    residual, base = residuals_and_base(explained, gains, pixels)
    root = np.sqrt(pixels.weight) * base
    residual = residual * root
    variance = float(np.sum(residual**2)) / max(pixels.used, 1)
    sizes = np.stack([root * np.asarray(_carrier(_with(wire, pupil=p), pixels.ideal)) for p in pupils])
    found = np.stack([_product(sizes, residual, _wave(_with(wire, standoff=s), pixels.ideal)) for s in standoffs])
    power = np.maximum(np.sum(sizes**2, axis=1), 1e-300)
    return 2 * np.abs(found) ** 2 / power / max(variance, 1e-300), np.angle(found)


def _product(sizes: Float[np.ndarray, "p n"], residual: Float[np.ndarray, " n"], wave: Array) -> np.ndarray:
    cosine, sine = np.asarray(wave)
    # residual = a cos(phase + t) = a (cos t cos(phase) - sin t sin(phase)): the angle found is t.
    return np.asarray(sizes @ (residual * cosine) - 1j * (sizes @ (residual * sine)))


def _with(wire: Wire, standoff: float | None = None, pupil: float | None = None) -> Wire:
    standoff = float(wire.standoff_per_pitch) if standoff is None else standoff
    pupil = float(wire.pupil_per_pitch) if pupil is None else pupil
    leaves = np.float64(standoff), np.float64(pupil)
    return eqx.tree_at(lambda w: (w.standoff_per_pitch, w.pupil_per_pitch), wire, leaves)


def _placed(wire: Wire, standoff: float, pupil: float, axis: int, angle: float) -> Wire:
    offset = np.array(wire.offset, dtype=np.float64)
    offset[axis] = float(angle) / (2 * np.pi)
    return eqx.tree_at(lambda w: w.offset, _with(wire, standoff, pupil), offset)
