"""From a session to the crops that the psf fit works on: brackets are merged, the wire is divided out."""

from __future__ import annotations

from dataclasses import dataclass, replace

import equinox as eqx
import numpy as np
from jaxtyping import Float

from udccal.fitting.hdr.merge import merge_bracket
from udccal.fitting.psf.shots import SEARCH_PX, Crop, Shots, cut_crop, shot_noise, stack
from udccal.models.noise import Noise
from udccal.models.wire import Wire, wire_values
from udccal.sessions.schema import LedSubject, StoredStep
from udccal.sessions.store import Session

# So many samples about the LED that are clipped even in the shortest exposure make a shot useless: without its
# brightest sample, neither the LED's light nor its place is known.
_CLIPPED_SAMPLES = 1
_CORE_PX = 3

_values = eqx.filter_jit(wire_values)


@dataclass(frozen=True)
class Reading:
    """What was found: ``shots`` is None when there is none to use; counts of shots by what was wrong with them.

    ``steps`` are those that the shots are of.
    """

    shots: Shots | None
    steps: tuple[StoredStep, ...]
    taken: int
    dark: int
    clipped: int


def window_half(session: Session, largest: tuple[int, int]) -> tuple[int, int]:
    """(rows, columns) to either side of the LED that the regions captured can fill."""
    regions = [c.region for step in session.steps("psf") for c in step.captures]
    rows, columns = (min((getattr(r, name) for r in regions), default=0) for name in ("rows", "columns"))
    return max(4, min(largest[0], rows // 2 - 4)), max(4, min(largest[1], columns // 2 - 4))


def read_shots(
    session: Session, noise: Noise, wire: Wire, half: tuple[int, int], steps: tuple[StoredStep, ...] | None = None
) -> Reading:
    """Crops of ``half`` (rows, columns) to either side of the LED, from all steps of the term psf or some of them.

    Raises:
        SessionError: when a file is missing or damaged.
    """
    crops, aims, discs, used, dark, clipped = [], [], [], [], 0, 0
    steps = tuple(session.steps("psf")) if steps is None else steps
    for step in steps:
        subject = step.subject
        if not isinstance(subject, LedSubject):
            continue
        crop, full = _read_shot(session, step, subject, noise, half)
        clipped += full
        dark += crop is None and not full
        if crop is not None and not full:
            crops.append(crop)
            used.append(step)
            aims.append((subject.x_px, subject.y_px))
            # The pupil is a few mm behind the panel: less than a percent of any useful distance.
            behind = session.rig.mounting.standoff_mm.value
            discs.append(subject.diameter_mm / (subject.distance_mm + behind) * session.rig.focal_px)
    if not crops:
        return Reading(None, (), len(steps), dark, clipped)
    shots = stack(crops, np.array(aims), np.array(discs))
    camera = session.rig.camera
    shots = without_wire(shots, wire, camera.rows, camera.columns)
    return Reading(shots, tuple(used), len(steps), dark, clipped)


def without_wire(shots: Shots, wire: Wire, rows: int, columns: int) -> Shots:
    """Rates divided by the wire's map of a sensor of ``rows`` x ``columns``."""
    pixels = shots.offsets()[None] + shots.origin_px[:, None, None]
    gains = np.stack([np.asarray(_values(wire, p.reshape(-1, 2) * 1.0, rows, columns)) for p in pixels])
    gain = gains.reshape(shots.rate.shape)
    return replace(
        shots, rate=shots.rate / gain, weight=shots.weight * gain**2, noise_per_rate=shots.noise_per_rate / gain
    )


def _read_shot(
    session: Session, step: StoredStep, subject: LedSubject, noise: Noise, half: tuple[int, int]
) -> tuple[Crop | None, bool]:
    """The crop, and whether the LED is clipped in all exposures. Only the part about the aim is merged."""
    region = step.captures[0].region
    reach = [h + SEARCH_PX + 2 for h in half]
    first = _part(subject.y_px - region.y, reach[0], region.rows)
    across = _part(subject.x_px - region.x, reach[1], region.columns)
    captures = [c for c in step.captures if c.region == region]
    frames = np.stack([session.frame(c)[first, across] for c in captures])
    exposures = np.array([c.exposure_s for c in captures])
    merged = merge_bracket(frames, exposures, noise)
    corner = (region.x + across.start, region.y + first.start)
    full = int((merged.used == 0).sum()) >= _CLIPPED_SAMPLES and _is_clipped(frames, exposures, noise)
    if full:
        return None, True
    aim, slope = (subject.x_px, subject.y_px), shot_noise(merged, noise)
    return cut_crop(merged, corner, aim, session.rig.camera.cfa, half, slope), False


def _part(aim: float, reach: int, size: int) -> slice:
    """Even start, so that the pattern of the mosaic stays the sensor's."""
    start = int(np.clip(np.floor(aim) - reach, 0, max(size - 2, 0))) // 2 * 2
    return slice(start, int(np.clip(np.ceil(aim) + reach + 1, start + 2, size)))


def _is_clipped(frames: np.ndarray, exposures_s: Float[np.ndarray, " n"], noise: Noise) -> bool:
    shortest = frames[int(np.argmin(exposures_s))]
    return int((shortest >= 0.98 * float(noise.saturation_DN)).sum()) >= _CLIPPED_SAMPLES
