"""Reads a session's LED pictures: brackets merged, crops cut about the LED, the wire divided out."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
import scipy.ndimage
from jaxtyping import Float

from udccal.cfa import cfa_named
from udccal.fitting.hdr.merge import HdrMerge, merge_bracket
from udccal.fitting.psf.data import PsfData, PsfRules, Shots, joined
from udccal.kernels import kernel_size
from udccal.models.noise import Noise
from udccal.result import FitStatus
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
    x, y = np.moveaxis(shots.offsets()[None] + shots.origin_px[:, None, None], -1, 0)
    gain = wire_map[np.clip(y, 0, wire_map.shape[0] - 1), np.clip(x, 0, wire_map.shape[1] - 1)]
    return replace(
        shots, rate=shots.rate / gain, weight=shots.weight * gain**2, noise_per_rate=shots.noise_per_rate / gain
    )


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
    rate = merged.rate_e_per_s
    # Rounding moves the faintest samples alike: thousands of them would outvote the kernel's bright part. The mean of
    # neighbours chooses them, so that a sample's own noise does not.
    known = merged.used > 0
    if merged.rounded_below > 0:
        known &= scipy.ndimage.uniform_filter(rate, 3) >= merged.rounded_below
    weight = np.where(known, 1.0 / merged.sigma_e_per_s.astype(np.float64) ** 2, 0.0)
    place = _brightest(rate, weight, np.asarray(aim_px) - corner_px)
    if place is None:
        return None
    x, y = middle = np.round(place).astype(np.int64)
    slope = np.zeros_like(rate) if noise_per_rate is None else noise_per_rate
    parts = (
        np.pad(part, [2 * (h,) for h in half])
        for part in (rate, weight, cfa_named(cfa).channel_map(*rate.shape), slope)
    )
    windows = (part[None, y : y + 2 * half[0] + 1, x : x + 2 * half[1] + 1] for part in parts)
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
