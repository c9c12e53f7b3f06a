"""Wire fit: from the average of flats to a smooth, noise-free map of the panel's modulation and the shading.

Maximum a posteriori with the rig description as prior: every pixel weighs by the variance that its expected signal
brings (shot, read and quantisation noise over the frames, PRNU), pixels that clip by the model are left out, outliers
are listed. A search on few pixels is followed by one joint fit of shape and fields on many.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from udccal.fitting.wire.basis import sample_pixels
from udccal.fitting.wire.harmonics import WireStart, full_basis, possible_harmonics, wire_start
from udccal.fitting.wire.joint import fit_joint, settle
from udccal.fitting.wire.misfit import misfit
from udccal.fitting.wire.noise import FlatNoise, flat_noise, judge, site_numbers
from udccal.fitting.wire.omitted import omitted, unseen, with_omitted
from udccal.fitting.wire.phase import fit_phase
from udccal.fitting.wire.result import wire_result
from udccal.fitting.wire.scan import ideal_wire
from udccal.fitting.wire.sigma import MapSigma, map_sigma
from udccal.models.geometry import Geometry
from udccal.models.noise import Noise
from udccal.models.wire import Wire, wire_map, wire_values
from udccal.numerics import in_float64
from udccal.result import FitResult, FitStatus
from udccal.sessions.store import Session

# Of the pixels that the joint fit has: so many for the search of the phase, and for its fit.
SEARCH_SHARE, PHASE_SHARE = 1 / 15, 1 / 6
PHASE_HARMONICS = 24
# More samples than this gain little: the map's sigma is PRNU sqrt(parameters / samples).
FIELD_SAMPLES = 300_000
_LEAST_SAMPLES = 4000
# Of one pixel of the average; there are thousands.
_LEAST_SIGNAL_TO_NOISE = 1.0
_MOST_SATURATED = 0.05
# Single frames must stay so many sigma below saturation, or their average is bent.
_HEADROOM = 5.0
_MEAN_GRID = (192, 256)


@final
@dataclass(frozen=True)
class WireFit:
    """The fitted term, and how sure its map is at any pixel; none where the fit failed."""

    result: FitResult[Wire]
    sigma: MapSigma | None


def fit_wire(session: Session, noise: Noise, geometry: Geometry, field_samples: int = FIELD_SAMPLES) -> FitResult[Wire]:
    """Fit the wire term to the steps ``wire/dark`` and ``wire/flat`` of a session; see ``fit_wire_session``."""
    return fit_wire_session(session, noise, geometry, field_samples).result


def fit_wire_session(session: Session, noise: Noise, geometry: Geometry, field_samples: int = FIELD_SAMPLES) -> WireFit:
    """The same, and how sure the map is at every pixel.

    Args:
        session: holds both averages at one exposure.
        noise: for saturation and PRNU.
        geometry: where the rays go.
        field_samples: pixels of the joint fit; time grows with it, the map's sigma falls with its square root.

    Raises:
        SessionError: when a file of the session is missing or damaged.
    """
    flat = session.average(session.step("wire/flat").captures[0])
    dark = session.average(session.step("wire/dark").captures[0])
    saturation = float(np.asarray(noise.saturation_DN))
    clipped = float(np.mean(flat.mean >= 0.98 * saturation))
    start = wire_start(session.rig)
    if clipped > _MOST_SATURATED:
        failed = _failed(geometry, start, FitStatus.SATURATED, f"{100 * clipped:.1f} % of the flat is clipped.")
        return WireFit(failed, None)
    variance = flat.variance / flat.frames + dark.variance / dark.frames
    headroom = saturation - float(np.mean(dark.mean))
    clip = headroom - _HEADROOM * np.sqrt(max(headroom * float(np.asarray(noise.K_DN_per_e)), 0.0))
    prnu = float(np.asarray(noise.PRNU1288))
    return fit_wire_and_sigma(flat.mean - dark.mean, variance, geometry, start, prnu, field_samples, clip)


@in_float64
def fit_wire_and_sigma(
    signal: Float[np.ndarray, "rows columns"],
    variance: Float[np.ndarray, "rows columns"],
    geometry: Geometry,
    start: WireStart,
    prnu: float,
    field_samples: int = FIELD_SAMPLES,
    clip: float = np.inf,
    all_pixels: bool = False,
) -> WireFit:
    """Fit the wire to an averaged flat.

    Args:
        signal: flat minus dark, in any linear unit; colours need not be balanced.
        variance: of ``signal`` itself (after averaging), in its unit squared; PRNU not included. It is smoothed to a
            straight line against the signal before it weighs anything.
        geometry: where the rays go.
        start: from the rig description; its tolerances are the prior.
        prnu: relative pixel-to-pixel response, added to the variance.
        field_samples: pixels of the joint fit; the search makes do with a part of them.
        clip: signal from which on single frames clip; pixels that the model puts there are left out.
        all_pixels: take a last step with every pixel of the sensor, in some ten times the time.
    """
    means = _site_means(signal, clip)
    if not (np.isfinite(means).all() and (means > 0).all()):
        if not np.isfinite(means).all():
            note = "All of a CFA site is clipped, or no number; expose shorter."
            return WireFit(_failed(geometry, start, FitStatus.SATURATED, note), None)
        return WireFit(_failed(geometry, start, FitStatus.TOO_DARK, "A CFA site has no light; check the lamp."), None)
    rows, columns = signal.shape
    sites = site_numbers(rows, columns)
    values = signal / means[sites]
    noise = flat_noise(values, variance, means, prnu, clip)
    if signal.size < _LEAST_SAMPLES:
        note = f"There are {signal.size} pixels; use a larger region of the sensor."
        return WireFit(_failed(geometry, start, FitStatus.TOO_FEW_DATA, note), None)
    expected = np.sqrt(noise.variance(np.arange(4), np.ones(4)))
    if float(np.min(1 / expected)) < _LEAST_SIGNAL_TO_NOISE:
        note = f"A pixel's noise is {float(expected.max()):.2g} of its signal. Average more frames, or expose longer."
        return WireFit(_failed(geometry, start, FitStatus.TOO_DARK, note), None)
    return _fitted(values, noise, geometry, start, field_samples, all_pixels)


def _fitted(
    values: Float[np.ndarray, "rows columns"],
    noise: FlatNoise,
    geometry: Geometry,
    start: WireStart,
    field_samples: int,
    all_pixels: bool,
) -> WireFit:
    sites = site_numbers(*values.shape)
    variance = noise.variance(sites, np.ones(values.shape))
    # To begin with, pixels that clip are left out by their own values; later, by the model's.
    variance = np.where(values < noise.clip[sites], variance, 0.0)
    step = _odd_step(values.size, field_samples)
    few, coarse = (
        sample_pixels(values, variance, geometry, _odd_step(values.size, max(int(share * field_samples), 1)))
        for share in (SEARCH_SHARE, PHASE_SHARE)
    )
    harmonics, sizes = possible_harmonics(start)
    phase = fit_phase(geometry, start, noise, few, coarse, harmonics, PHASE_HARMONICS)
    basis = full_basis(sizes if phase.present else sizes[:0], phase.basis)
    joint = fit_joint(phase, sample_pixels(values, variance, geometry, step), noise, basis, phase.wire)
    if all_pixels and step > 1:
        every = sample_pixels(values, variance, geometry, 1)
        joint, step = settle(phase, joint.wire, joint.gains, every, noise, joint.basis, joint.candidates), 1
    wire = _mean_one(joint.wire, values.shape)
    sigma = map_sigma(joint, wire, *values.shape)
    seen = judge(joint.wire, joint.gains, joint.judged.pixels, noise)
    judged = seen
    if step > 1:
        # In steps of three, for a sample of all CFA sites that the fit has not seen.
        others = sample_pixels(values, variance, geometry, 3 * step, step // 2)
        judged = judge(joint.wire, joint.gains, others, noise)
    found = misfit(joint, judged, sigma.rms(), held_out=step > 1)
    if phase.present:
        left_out = omitted(start, joint.wire, seen)
        found = with_omitted(found, left_out.sigma) if left_out else found
    else:
        found = with_omitted(found, unseen(sizes, few))
    sigma = replace(sigma, model=found.by_tile)
    term = _trimmed(wire) if phase.present else _bare(wire)
    return WireFit(wire_result(phase, joint, found, sigma, term, values.size), sigma)


@in_float64
def sensor_map(wire: Wire, rows: int, columns: int) -> Float[np.ndarray, "rows columns"]:
    """The wire at every pixel of the sensor. It takes seconds: keep it."""
    return np.asarray(wire_map(wire, rows, columns), dtype=np.float64)


def _odd_step(pixels: int, samples: int) -> int:
    step = max(1, pixels // samples)
    return step + 1 - step % 2


def _site_means(signal: Float[np.ndarray, "rows columns"], clip: float) -> Float[np.ndarray, "4"]:
    """Of what is neither clipped nor not a number; not a number where nothing is left."""
    means = []
    for k in range(4):
        site = signal[k // 2 :: 2, k % 2 :: 2]
        good = site[np.isfinite(site) & (site < clip)]
        means.append(float(good.mean(dtype=np.float64)) if good.size else np.nan)
    return np.array(means)


def _trimmed(wire: Wire) -> Wire:
    """Without the Legendre degrees that no harmonic uses: the map costs less to compute."""
    used = np.flatnonzero(np.any(np.asarray(wire.fields) != 0, axis=(0, 1, 2)))
    count = int(used.max()) + 1 if used.size else 1
    return eqx.tree_at(lambda w: w.fields, wire, np.asarray(wire.fields)[..., :count])


def _bare(wire: Wire) -> Wire:
    """Without harmonics: an absent panel costs nothing later."""
    leaves = (np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, 2, 2, 1)), np.zeros((0, 2, 1, 1)))
    return eqx.tree_at(lambda w: (w.harmonics, w.frequency, w.fields, w.amplitudes), wire, leaves)


def _mean_one(wire: Wire, shape: tuple[int, ...]) -> Wire:
    """Scale the map to a mean of one over the sensor, by the midpoint rule on a regular grid."""
    down, across = ((np.arange(n) + 0.5) / n * size - 0.5 for n, size in zip(_MEAN_GRID, shape, strict=True))
    grid = np.stack(np.meshgrid(across, down), axis=-1).reshape(_MEAN_GRID[0] // 16, -1, 2)
    mean = float(np.mean([np.asarray(_values(wire, part, shape[0], shape[1])) for part in grid]))
    baseline = np.array(wire.baseline)
    baseline[0, 0] -= np.log(mean)
    return eqx.tree_at(lambda w: w.baseline, wire, baseline)


_values = jax.jit(wire_values, static_argnums=(2, 3))


def _failed(geometry: Geometry, start: WireStart, status: FitStatus, note: str) -> FitResult[Wire]:
    flat = ideal_wire(geometry, start, np.zeros((0, 2)))
    return FitResult.failed("wire", flat, status, note)
