"""What the psf fit works on: crops of merged LED pictures, the wire divided out, from a session or from arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Final, final

import equinox as eqx
import numpy as np
import scipy.ndimage
from jaxtyping import Bool, Float, Int

from udccal.cfa import channel_map
from udccal.fitting.hdr.merge import HdrMerge, merge_bracket
from udccal.fitting.psf.start import PsfRules
from udccal.kernels import kernel_size
from udccal.models.noise import Noise
from udccal.models.wire import Wire, wire_values
from udccal.sessions.schema import LedSubject, StoredStep
from udccal.sessions.store import Session

# How far from its aim an LED is looked for.
_SEARCH_PX: Final = 16

_wire_values = eqx.filter_jit(wire_values)


@final
@dataclass(frozen=True)
class Shots:
    """Crops of one size, one per picture of the LED, on Bayer sites, with their uncertainty.

    Attributes:
        centre_px: (x, y) on the sensor of the LED's image, as known so far.
        origin_px: (x, y) on the sensor of the crop's middle sample.
        position: index of the field position that the shot belongs to.
        disc_px: diameter of the LED's image.
        rate: e-/s; weight: 1 / sigma^2 in (e-/s)^-2, 0 where nothing is known; channel: 0, 1, 2 for R, G, B.
        noise_per_rate: how fast sigma^2 grows with the rate, in e-/s: the sigma of a sample that noise has made
            darker is too small, and a fit that went by it would come out too dark.
    """

    centre_px: Float[np.ndarray, "shots 2"]
    origin_px: Int[np.ndarray, "shots 2"]
    position: Int[np.ndarray, " shots"]
    disc_px: Float[np.ndarray, " shots"]
    rate: Float[np.ndarray, "shots rows columns"]
    weight: Float[np.ndarray, "shots rows columns"]
    channel: Int[np.ndarray, "shots rows columns"]
    noise_per_rate: Float[np.ndarray, "shots rows columns"]

    @property
    def count(self) -> int:
        """Number of pictures."""
        return self.rate.shape[0]

    @property
    def positions(self) -> int:
        """Number of field positions."""
        return int(self.position.max()) + 1

    @property
    def half(self) -> tuple[int, int]:
        """(rows, columns) to either side of the LED."""
        return self.rate.shape[1] // 2, self.rate.shape[2] // 2

    @property
    def colour(self) -> Float[np.ndarray, "shots rows columns 3"]:
        """Which of three colours a sample has (one-hot)."""
        return np.eye(3)[self.channel]

    def offsets(self) -> Int[np.ndarray, "rows columns 2"]:
        """(x, y) of every sample from the crop's middle sample."""
        y, x = np.mgrid[: self.rate.shape[1], : self.rate.shape[2]]
        return np.stack([x - self.half[1], y - self.half[0]], axis=-1)

    def pick(self, keep: np.ndarray) -> Shots:
        """The shots selected by an index or mask, their positions numbered without gaps."""
        picked = {field.name: getattr(self, field.name)[keep] for field in fields(self)}
        return Shots(**picked | {"position": np.unique(self.position[keep], return_inverse=True)[1].reshape(-1)})

    def within(self, largest: tuple[int, int]) -> Shots:
        """The middle of the crops, at most ``largest`` (rows, columns) to either side."""
        names = ("rate", "weight", "channel", "noise_per_rate")
        return replace(self, **{name: about_middle(getattr(self, name), largest) for name in names})

    def positions_px(self) -> Float[np.ndarray, "positions 2"]:
        """Mean place of the shots of every field position."""
        return np.stack([self.centre_px[self.position == g].mean(axis=0) for g in range(self.positions)])


def about_middle(images: np.ndarray, largest: tuple[int, int]) -> np.ndarray:
    """The middle of images of odd size, at most ``largest`` (rows, columns) to either side."""
    halves = zip(images.shape[-2:], largest, strict=True)
    rows, columns = (slice(max(n // 2 - most, 0), n // 2 + most + 1) for n, most in halves)
    return images[..., rows, columns]


def joined(crops: Sequence[Shots], aims_px: Float[np.ndarray, "shots 2"]) -> Shots:
    """Crops of one size together, grouped into field positions by where they were aimed."""
    together = Shots(*(np.concatenate([getattr(crop, field.name) for crop in crops]) for field in fields(Shots)))
    return replace(together, position=group(aims_px))


def group(aims_px: Float[np.ndarray, "shots 2"]) -> Int[np.ndarray, " shots"]:
    """Index of the field position of each shot: aims within 4 px of a position's first are shifts of it."""
    firsts: list[Float[np.ndarray, "2"]] = []
    index = np.zeros(len(aims_px), dtype=np.int64)
    for i, aim in enumerate(aims_px):
        near = [g for g, first in enumerate(firsts) if np.abs(aim - first).max() <= 4.0]
        index[i] = near[0] if near else len(firsts)
        if not near:
            firsts.append(aim)
    return index


def held_out_positions(count: int) -> Bool[np.ndarray, " positions"]:
    """Every fourth position, the second first, is left out while orders are compared; with three, one of them."""
    return np.arange(count) % 4 == 1


@final
@dataclass(frozen=True)
class PsfData:
    """What there is to fit.

    Attributes:
        shots: crops, which may be wider than the fit's windows: how far light reaches is seen in the whole of them.
            None where no picture can be used.
        taken, dark, clipped: pictures captured, and of these such without an LED, and such that are clipped.
    """

    shots: Shots | None
    taken: int = 0
    dark: int = 0
    clipped: int = 0


def read_psf(session: Session, noise: Noise, wire: Wire, rules: PsfRules | None = None) -> PsfData:
    """The LED pictures of the steps ``psf/...`` of a session, in windows as wide as a profile's kernel or the fit's.

    Args:
        session: brackets of an LED at field positions, each at some sub-pixel shifts.
        noise: for merging brackets.
        wire: divided out.
        rules: how large windows may be.

    Raises:
        SessionError: when a file of the session is missing or damaged.
    """
    kernel, least = kernel_size(session.rig), (rules or PsfRules()).half_px
    half = window_half(session, (max(kernel[0] // 2, least[0]), max(kernel[1] // 2, least[1])))
    crops, aims, dark, clipped = [], [], 0, 0
    steps = session.steps("psf")
    for step in steps:
        subject = step.subject
        if not isinstance(subject, LedSubject):
            continue
        crop, full = _read_shot(session, step, subject, noise, half)
        clipped += full
        dark += crop is None and not full
        if crop is not None:
            crops.append(crop)
            aims.append((subject.x_px, subject.y_px))
    camera = session.rig.camera
    shots = _without_wire(joined(crops, np.array(aims)), wire, camera.rows, camera.columns) if crops else None
    return PsfData(shots, len(steps), dark, clipped)


def window_half(session: Session, largest: tuple[int, int]) -> tuple[int, int]:
    """(rows, columns) to either side of the LED that the regions captured can fill."""
    regions = [c.region for step in session.steps("psf") for c in step.captures]
    rows, columns = (min((getattr(r, name) for r in regions), default=0) for name in ("rows", "columns"))
    return max(4, min(largest[0], rows // 2 - 4)), max(4, min(largest[1], columns // 2 - 4))


def _without_wire(shots: Shots, wire: Wire, rows: int, columns: int) -> Shots:
    """Rates divided by the wire's map of a sensor of ``rows`` x ``columns``."""
    pixels = shots.offsets()[None] + shots.origin_px[:, None, None]
    gains = np.stack([np.asarray(_wire_values(wire, p.reshape(-1, 2) * 1.0, rows, columns)) for p in pixels])
    gain = gains.reshape(shots.rate.shape)
    return replace(
        shots, rate=shots.rate / gain, weight=shots.weight * gain**2, noise_per_rate=shots.noise_per_rate / gain
    )


def _read_shot(
    session: Session, step: StoredStep, subject: LedSubject, noise: Noise, half: tuple[int, int]
) -> tuple[Shots | None, bool]:
    """The crop, and whether the LED is clipped in all exposures. Only the part about the aim is merged."""
    region, aim = step.captures[0].region, (subject.x_px, subject.y_px)
    down = _part(aim[1] - region.y, half[0] + _SEARCH_PX + 2, region.rows)
    across = _part(aim[0] - region.x, half[1] + _SEARCH_PX + 2, region.columns)
    captures = [c for c in step.captures if c.region == region]
    frames = np.stack([session.frame(c)[down, across] for c in captures])
    exposures_s = np.array([c.exposure_s for c in captures])
    merged, corner = merge_bracket(frames, exposures_s, noise), (region.x + across.start, region.y + down.start)
    # Without its brightest sample neither an LED's light nor its place is known.
    clipped = (merged.used == 0) & (frames[int(np.argmin(exposures_s))] >= 0.98 * float(noise.saturation_DN))
    # A hot pixel elsewhere is not the LED's.
    if clipped[tuple(_part(aim[i] - corner[i], _SEARCH_PX, clipped.shape[1 - i]) for i in (1, 0))].any():
        return None, True
    # The pupil is a few mm behind the panel: less than a percent of any useful distance.
    away_mm = subject.distance_mm + session.rig.mounting.standoff_mm.value
    disc_px = subject.diameter_mm / away_mm * session.rig.focal_px
    return cut_crop(merged, corner, aim, session.rig.camera.cfa, half, disc_px, shot_noise(merged, noise)), False


def _part(aim: float, reach: int, size: int) -> slice:
    """Even start, so that the pattern of the mosaic stays the sensor's."""
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
    """One shot about the LED, ``half`` (rows, columns) to either side; None when no light stands out near the aim.

    ``merged`` is the bracket of a region whose first sample is ``corner_px`` (x, y; even); beside it samples have no
    weight. The aim is on the sensor; ``disc_px`` is the diameter of the LED's image. Without ``noise_per_rate`` (see
    ``shot_noise``) the merged sigma is taken as it is.
    """
    rate = merged.rate_e_per_s
    weight = np.where(merged.used > 0, 1.0 / merged.sigma_e_per_s.astype(np.float64) ** 2, 0.0)
    place = _brightest(rate, weight, np.asarray(aim_px) - corner_px)
    if place is None:
        return None
    x, y = middle = np.round(place).astype(np.int64)
    slope = np.zeros_like(rate) if noise_per_rate is None else noise_per_rate
    parts = (np.pad(part, [2 * (h,) for h in half]) for part in (rate, weight, channel_map(cfa, *rate.shape), slope))
    windows = (part[None, y : y + 2 * half[0] + 1, x : x + 2 * half[1] + 1] for part in parts)
    where = (place + corner_px)[None], (middle + corner_px)[None], np.zeros(1, dtype=np.int64), np.array([disc_px])
    return Shots(*where, *windows)


def _brightest(
    rate: Float[np.ndarray, "rows columns"], weight: Float[np.ndarray, "rows columns"], aim: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "2"] | None:
    """(x, y) of the LED: centroid about the brightest 2 x 2 cell near the aim, or None when it is not there.

    A cell holds every colour, so that the mosaic does not steer the search; hot pixels are too narrow to win it.
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
    # An LED stands out of the noise by 8 sigma.
    if signal.max(initial=0.0) < 8.0 * np.median(noise) or signal.sum() <= 0:
        return None
    return np.array([np.average(x[about], weights=signal), np.average(y[about], weights=signal)])


def shot_noise(merged: HdrMerge, noise: Noise) -> Float[np.ndarray, "rows columns"]:
    """How fast a merged sample's variance grows with its rate, in (e-/s)^2 per e-/s.

    Variance (r + d) u + f u^2 is that of one exposure of 1/u seconds, f being what a dark sample has; a bracket is
    taken for the single exposure that has its variance.
    """
    K, dark = float(np.asarray(noise.K_DN_per_e)), float(np.asarray(noise.dark_current_e_per_s))
    floor = float(np.asarray(noise.sigma_d_e)) ** 2 + (float(np.asarray(noise.q_DN)) / K) ** 2 / 12.0
    light, variance = np.maximum(merged.rate_e_per_s + dark, 0.0), merged.sigma_e_per_s**2
    slope = 2.0 * variance / (light + np.sqrt(light**2 + 4.0 * floor * variance))
    return np.where(merged.used > 0, slope, 0.0)
