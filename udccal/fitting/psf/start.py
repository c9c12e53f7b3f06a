"""What a fit starts from: crops read from a session, which of them it looks at, and start and prior of diffraction.

Of a session's LED pictures, brackets are merged, crops cut about the LED, and the wire divided out.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import jax
import numpy as np
import scipy.ndimage
from jaxtyping import Bool, Float

from udccal.cfa import cfa_named
from udccal.fitting.engine.gaussian import Prior
from udccal.fitting.hdr.merge import HdrMerge, merge_bracket
from udccal.fitting.psf.data import PsfData, PsfRules, Shots, held_out_positions, joined
from udccal.fitting.psf.kernel import HEAD, WAVELENGTHS_NM
from udccal.kernels import kernel_size
from udccal.models.diffraction import Diffraction
from udccal.models.geometry import Geometry
from udccal.models.noise import Noise
from udccal.models.wire import Wire
from udccal.result import FitStatus
from udccal.rig import RigDescription
from udccal.sessions.schema import LedSubject, StoredStep
from udccal.sessions.store import Session

# The search for an LED reaches this far from its aim.
_SEARCH_PX: Final = 16


def read_psf(
    session: Session, noise: Noise, wire_map: Float[np.ndarray, "rows columns"], rules: PsfRules | None = None
) -> PsfData:
    """Read the LED pictures of a session's steps ``psf/...``, in windows as wide as a profile's kernel or the fit's.

    Args:
        session: brackets of an LED at field positions, each at some sub-pixel shifts.
        noise: gives K, black level, saturation and variances for merging brackets.
        wire_map: the wire at every pixel of the sensor, which divides the rates.
        rules: the largest windows in px.

    Returns:
        Crops in e-/s about each LED, and the numbers of dark and clipped pictures.

    Raises:
        SessionError: when a file of the session is missing or damaged.
    """
    kernel, least = kernel_size(session.rig), (rules or PsfRules()).half_px
    half = window_half(session, (max(kernel[0] // 2, least[0]), max(kernel[1] // 2, least[1])))
    crops, aims, dark, clipped, doubted = [], [], 0, 0, list[str]()
    # Positions are chosen by their number, evenly over the field. A person is led through the rows back and forth.
    steps = sorted(session.steps("psf"), key=lambda step: step.id)
    for step in steps:
        subject = step.subject
        if not isinstance(subject, LedSubject):
            continue
        crop, full, doubts = _read_shot(session, step, subject, noise, half)
        doubted += doubts
        clipped += full
        dark += crop is None and not full
        if crop is not None:
            crops.append(crop)
            aims.append((subject.x_px, subject.y_px))
    shots = _without_wire(joined(crops, np.array(aims)), wire_map) if crops else None
    return PsfData(shots, len(steps), dark, clipped, tuple(doubted))


def window_half(session: Session, largest: tuple[int, int]) -> tuple[int, int]:
    """Return (rows, columns) to either side of the LED that the captured regions can fill."""
    regions = [c.region for step in session.steps("psf") for c in step.captures]
    rows, columns = (min((getattr(r, name) for r in regions), default=0) for name in ("rows", "columns"))
    return max(4, min(largest[0], rows // 2 - 4)), max(4, min(largest[1], columns // 2 - 4))


def _without_wire(shots: Shots, wire_map: Float[np.ndarray, "rows columns"]) -> Shots:
    """Divide rates by the wire; samples beyond the sensor have no weight."""
    x, y = np.moveaxis(shots.offsets() + shots.origin_px[:, None, None], -1, 0)
    gain = wire_map[np.clip(y, 0, wire_map.shape[0] - 1), np.clip(x, 0, wire_map.shape[1] - 1)]
    rate, slope = shots.rate / gain, shots.noise_per_rate / gain
    return replace(shots, rate=rate, weight=shots.weight * gain**2, noise_per_rate=slope)


def _read_shot(
    session: Session, step: StoredStep, subject: LedSubject, noise: Noise, half: tuple[int, int]
) -> tuple[Shots | None, bool, list[str]]:
    """Return the crop, True if the LED is clipped in all exposures, and what the merge says against the noise model.

    Only the part near the aim is merged.
    """
    region, aim = step.captures[0].region, (subject.x_px, subject.y_px)
    down = _part(aim[1] - region.y, half[0] + _SEARCH_PX + 2, region.rows)
    across = _part(aim[0] - region.x, half[1] + _SEARCH_PX + 2, region.columns)
    captures = [c for c in step.captures if c.region == region]
    frames = np.stack([session.frame(c)[down, across] for c in captures])
    exposures_s = np.array([c.exposure_s for c in captures])
    merged, corner = merge_bracket(frames, exposures_s, noise), (region.x + across.start, region.y + down.start)
    # An LED without its brightest sample has no known light or place.
    clipped = (merged.used == 0) & (frames[int(np.argmin(exposures_s))] >= 0.98 * float(noise.saturation_DN))
    # A hot pixel elsewhere does not belong to the LED.
    if clipped[tuple(_part(aim[i] - corner[i], _SEARCH_PX, clipped.shape[1 - i]) for i in (1, 0))].any():
        return None, True, []
    # The pupil is a few mm behind the panel: less than a percent of any useful distance.
    away_mm = subject.distance_mm + session.rig.mounting.standoff_mm.value
    disc_px = subject.diameter_mm / away_mm * session.rig.focal_px
    doubts = [f"{step.id}: {' '.join(merged.notes)}"] if merged.status is FitStatus.POOR_FIT else []
    crop = cut_crop(merged, corner, aim, session.rig.camera.cfa, half, disc_px, shot_noise(merged, noise))
    return crop, False, doubts


def _part(aim: float, reach: int, size: int) -> slice:
    """Return a slice with an even start, so that the pattern of the mosaic stays the sensor's."""
    start = int(np.clip(np.floor(aim) - reach, 0, max(size - 2, 0))) // 2 * 2
    return slice(start, int(np.clip(np.ceil(aim) + reach + 1, start + 2, size)))


def cut_crop(
    merged: HdrMerge,
    corner_px: tuple[int, int],
    aim_px: tuple[float, float],
    cfa: str,
    half: tuple[int, int],
    disc_px: float,
    noise_per_rate: Float[np.ndarray, "rows columns"] | None = None,
) -> Shots | None:
    """Cut a shot about the LED, ``half`` (rows, columns) to either side; return None without a visible LED at the aim.

    ``merged`` is the bracket of a region whose first sample is ``corner_px`` (x, y; even); samples outside it have no
    weight. The aim is on the sensor; ``disc_px`` is the diameter of the LED's image. Without ``noise_per_rate`` (see
    ``shot_noise``) the merged sigma stays unchanged.
    """
    rate, known = merged.rate_e_per_s, merged.used > 0
    # Rounding moves the faintest samples alike: thousands of them would outvote the kernel's bright part. The mean of
    # neighbours chooses them, so that a sample's own noise does not.
    if merged.rounded_below > 0:
        known &= scipy.ndimage.uniform_filter(rate, 3) >= merged.rounded_below
    weight = np.where(known, 1.0 / merged.sigma_e_per_s.astype(np.float64) ** 2, 0.0)
    place = _brightest(rate, weight, np.asarray(aim_px) - corner_px)
    if place is None:
        return None
    x, y = middle = np.round(place).astype(np.int64)
    slope = 0.0 if noise_per_rate is None else noise_per_rate
    parts = np.broadcast_arrays(rate, weight, cfa_named(cfa).channel_map(*rate.shape), slope)
    padded = (np.pad(part, [2 * (h,) for h in half]) for part in parts)
    windows = (part[None, y : y + 2 * half[0] + 1, x : x + 2 * half[1] + 1] for part in padded)
    where = (place + corner_px)[None], (middle + corner_px)[None], np.zeros(1, dtype=np.int64), np.array([disc_px])
    return Shots(*where, *windows)


def _brightest(
    rate: Float[np.ndarray, "rows columns"], weight: Float[np.ndarray, "rows columns"], aim: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "2"] | None:
    """Return (x, y) of the LED, the centroid about the brightest 2 x 2 cell near the aim, or None without an LED.

    A cell holds every colour, so that the mosaic does not bias the search; a hot pixel is too narrow to be found.
    """
    known = np.where(weight > 0, rate, 0.0)
    cells = scipy.ndimage.uniform_filter(scipy.ndimage.median_filter(known, size=3) + 0.02 * known, size=3)
    y, x = np.mgrid[: rate.shape[0], : rate.shape[1]]
    near = (np.abs(x - aim[0]) <= _SEARCH_PX) & (np.abs(y - aim[1]) <= _SEARCH_PX)
    if not near.any():
        return None
    row, column = np.unravel_index(np.argmax(np.where(near, cells, -np.inf)), rate.shape)
    about = (np.abs(x - column) <= 2) & (np.abs(y - row) <= 2)
    signal = np.maximum(known[about], 0.0)
    noise = np.sqrt((1.0 / np.maximum(weight[about], 1e-300)).clip(max=1e24))
    # An LED exceeds the noise by 8 sigma.
    if signal.max(initial=0.0) < 8.0 * np.median(noise) or signal.sum() <= 0:
        return None
    return np.array([np.average(x[about], weights=signal), np.average(y[about], weights=signal)])


def shot_noise(merged: HdrMerge, noise: Noise) -> Float[np.ndarray, "rows columns"]:
    """Return the derivative of a merged sample's variance by its rate, in (e-/s)^2 per e-/s.

    One exposure of 1/u seconds has the variance (r + d) u + f u^2, where f is a dark sample's, its pixel's offset
    included. A bracket is treated as the single exposure that has its variance.
    """
    parts = noise.K_DN_per_e, noise.dark_current_e_per_s, noise.sigma_d_e, noise.q_DN, noise.DSNU1288_e
    K, dark, sigma_d, q, offset = (float(np.asarray(part)) for part in parts)
    floor = sigma_d**2 + (q / K) ** 2 / 12.0 + offset**2
    light, variance = np.maximum(merged.rate_e_per_s + dark, 0.0), merged.sigma_e_per_s**2
    slope = 2.0 * variance / (light + np.sqrt(light**2 + 4.0 * floor * variance))
    return np.where(merged.used > 0, slope, 0.0)


def start_model(rig: RigDescription, geometry: Geometry, wire: Wire, rules: PsfRules | None = None) -> Diffraction:
    """Return the start of diffraction: the wire's panel and pupil, or the rig's if no wire was seen.

    Args:
        rig: the panel and the lens as described; lengths in mm.
        geometry: has the pupil's position, in mm.
        wire: its numbers are in pitches of the panel.
        rules: the blur, and which pitches are well known.
    """
    panel, pitch, rules = rig.panel, rig.panel.pitch_mm.value, rules or PsfRules()
    nodes = wavelengths_nm(rig, rules)
    # Those of common colour filters.
    responses = np.exp(-0.5 * ((nodes - np.array([[600.0], [535.0], [460.0]])) / 45.0) ** 2) + 1e-3
    pupil = np.asarray(geometry.pupil_mm, dtype=np.float64)
    # Only a wire fit that saw the rows knows the place of the pupil's footprint on them.
    if seen := np.shape(wire.harmonics)[0] > 0:
        opened, offset = (wire.column_open, wire.row_open), wire.offset_periods
        lengths = (wire.depth_per_pitch, wire.footprint_per_pitch, wire.standoff_per_pitch)
    else:
        opened, offset = (panel.column_open.value, panel.row_open.value), pupil[:2] / pitch
        lengths = (panel.depth_mm.value / pitch, rig.pupil_diameter_mm / pitch, -pupil[2] / pitch)
    depth, footprint, standoff = (np.float64(float(length)) for length in lengths)
    return Diffraction(
        pitch_mm=np.float64(pitch),
        openings=np.array([float(part) for part in opened]),
        depth_mm=depth * pitch,
        depth_ratio=np.float64(0.0),
        bar_width=np.zeros(2),
        bar_place=np.zeros(2),
        corner_radius=np.float64(0.0),
        slant=np.zeros(2),
        pupil_diameter_mm=footprint * pitch,
        blur_px=np.float64(rules.blur_px),
        blur_growth=np.zeros(2),
        blur_colour=np.zeros(3),
        offset_periods=np.asarray(offset, dtype=np.float64),
        standoff_per_pitch=standoff,
        visibility=np.float64(seen),
        wavelengths_nm=nodes,
        spectrum=responses / responses.sum(axis=1, keepdims=True),
    )


def pack(model: Diffraction) -> Float[np.ndarray, " p"]:
    """Return the parameters as one vector: see ``Evaluator.model``; blur, corners, slants and spectra as logarithms.

    The kernel depends on the square of each. The logarithm avoids its two signs and its zero derivative at 0.
    """
    logs = np.log(np.maximum(np.asarray(model.spectrum), 1e-6))
    red, green, blue = np.asarray(model.blur_colour)
    lens = [np.log(model.blur_px) + green, *np.asarray(model.blur_growth), red - green, blue - green]
    head = [model.pitch_mm, *np.asarray(model.openings), model.depth_mm, model.pupil_diameter_mm, *lens]
    head += [model.depth_ratio, *np.asarray(model.bar_width), *np.asarray(model.bar_place)]
    head += np.log(np.maximum([model.corner_radius, *model.slant], 1e-6)).tolist()
    head += [*np.asarray(model.offset_periods), model.standoff_per_pitch]
    return np.concatenate([np.array(head, dtype=float), (logs - logs.mean(axis=1, keepdims=True)).ravel()])


def as_numpy(model: Diffraction) -> Diffraction:
    """Return the model with numpy leaves."""
    return jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), model)


def wavelengths_nm(rig: RigDescription, rules: PsfRules) -> Float[np.ndarray, " nodes"]:
    """Return the spectra's nodes in nm: those of daylight, wider by the pitch's tolerance where that is large."""
    relative = min(pitch_tolerance(rig), rules.pitch_least_known)
    if relative <= rules.pitch_well_known:
        return WAVELENGTHS_NM
    first, last = WAVELENGTHS_NM[0] * (1 - relative), WAVELENGTHS_NM[-1] * (1 + relative)
    return np.linspace(first, last, round((last - first) / (WAVELENGTHS_NM[1] - WAVELENGTHS_NM[0])) + 1)


def pitch_tolerance(rig: RigDescription) -> float:
    """Return the relative tolerance of the pitch, in which the psf measures all lengths."""
    return rig.panel.pitch_mm.tolerance / rig.panel.pitch_mm.value


def start_prior(rig: RigDescription, start: Diffraction, rules: PsfRules | None = None) -> Prior:
    """Return the prior: the rig's tolerances, tighter for what the wire has measured, and smooth spectra.

    Diffraction depends on wavelength / pitch only. The pitch is therefore held at the rig's value, and the spectra are
    free to move: an error of the pitch then appears as an error of the wavelengths.

    Args:
        rig: its tolerances (mm, or fractions) are taken for standard deviations.
        start: the mean; its ``visibility`` says whether the wire has measured the panel's numbers.
        rules: sigmas of the other parameters.
    """
    panel, theta, rules = rig.panel, pack(start), rules or PsfRules()
    tighter = rules.wire_tolerance if start.visibility else 1.0
    pitch_mm = rules.pitch_tolerance * min(panel.pitch_mm.tolerance, rules.pitch_well_known * panel.pitch_mm.value)
    pupil_mm = 2.0 * rig.pupil_diameter_mm * rig.lens.f_number.tolerance / rig.lens.f_number.value
    of_wire = [panel.column_open.tolerance, panel.row_open.tolerance, panel.depth_mm.tolerance, pupil_mm]
    of_blur = np.repeat([rules.blur_log_sigma, rules.blur_growth, rules.blur_colour], (1, 2, 2))
    # Of plain openings, numbers of their shape are held.
    of_shape, of_footprint = [0.0] * 7, [rules.footprint_periods] * 3
    sigma = [pitch_mm, *(tighter * np.array(of_wire)), *of_blur, rules.depth_ratio, *of_shape, *of_footprint]
    roots = [np.eye(HEAD, theta.size) / np.maximum(np.array(sigma), 1e-6)[:, None]]
    for pick in np.eye(theta.size)[HEAD:].reshape(3, -1, theta.size):
        roots += [np.diff(pick, 2, axis=0) / rules.spectrum_bend, pick / rules.spectrum_sigma]
    return Prior(theta.copy(), np.concatenate(roots))


def some_shots(shots: Shots, rules: PsfRules) -> Bool[np.ndarray, " shots"]:
    """Choose shots for the fit of diffraction, evenly over the positions not held out and over their shifts."""

    def spread(items: np.ndarray, most: int) -> np.ndarray:
        return items[np.unique(np.linspace(0, len(items) - 1, most).round().astype(int))]

    keep = np.zeros(shots.count, dtype=bool)
    for place in spread(np.flatnonzero(~held_out_positions(shots.positions)), rules.positions):
        keep[spread(np.flatnonzero(shots.position == place), rules.shifts)] = True
    return keep


def choose_samples(shots: Shots, rules: PsfRules) -> Bool[np.ndarray, "shots rows columns"]:
    """Return which samples are fitted: all near the peak and a seeded draw of the others, as many in every shot."""
    rng = np.random.default_rng(2)
    x, y = np.moveaxis(np.abs(shots.offsets()), -1, 0)
    inside = (x <= rules.close_px[1]) & (y <= rules.close_px[0])
    near = (x <= rules.peak_half_px[1]) & (y <= rules.peak_half_px[0]) & inside
    far = np.flatnonzero((inside & ~near).ravel())
    chosen = np.tile(near.ravel(), (shots.count, 1))
    for row in chosen:
        row[rng.choice(far, round(len(far) * rules.far_fraction), replace=False)] = True
    return chosen.reshape(shots.rate.shape)


def stands_for(shots: Shots, rules: PsfRules) -> Float[np.ndarray, "shots n"]:
    """Return how many samples of a picture each chosen one represents: 1 near the peak, more where it was drawn."""
    chosen, near = choose_samples(shots, rules), choose_samples(shots, replace(rules, far_fraction=0.0))
    return np.where(near[chosen].reshape(shots.count, -1), 1.0, 1.0 / rules.far_fraction)
