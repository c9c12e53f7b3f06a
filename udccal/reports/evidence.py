"""Computes from the session the numbers of the report's pictures that a fit does not keep."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from udccal.cfa import cfa_named
from udccal.models.noise import Noise
from udccal.sessions.schema import StoredStep
from udccal.sessions.store import Session

_CHANNELS = 3


@dataclass(frozen=True)
class PhotonTransfer:
    """Temporal variance over mean signal of pairs of flats, both above dark, per level and colour (EMVA 1288)."""

    mean_DN: Float[np.ndarray, "levels 3"]
    variance_DN2: Float[np.ndarray, "levels 3"]
    slope_DN_per_e: float
    saturation_DN: float


def photon_transfer(session: Session, noise: Noise) -> PhotonTransfer | None:
    """Return the photon-transfer points of a session's pairs of flats and darks; None when it has none."""
    flats, darks = _pairs(session, "noise/flat_"), _pairs(session, "noise/dark_")
    levels = sorted(set(flats) & set(darks))
    if not levels:
        return None
    points = np.array([[_pair(session, flats[i]), _pair(session, darks[i])] for i in levels])
    above_dark = points[:, 0] - points[:, 1]
    return PhotonTransfer(
        mean_DN=above_dark[:, 0],
        variance_DN2=above_dark[:, 1],
        slope_DN_per_e=float(np.asarray(noise.K_DN_per_e)),
        saturation_DN=float(np.asarray(noise.saturation_DN) - np.asarray(noise.black_DN)),
    )


def _pairs(session: Session, prefix: str) -> dict[str, StoredStep]:
    """Return the steps of two single frames, by the rest of their id after ``prefix``."""
    return {s.id.removeprefix(prefix): s for s in session.steps("noise") if s.id.startswith(prefix) and _is_pair(s)}


def _is_pair(step: StoredStep) -> bool:
    return len(step.captures) == 2 and all(capture.kind == "frame" for capture in step.captures)


def _pair(session: Session, step: StoredStep) -> Float[np.ndarray, "2 3"]:
    """Return mean and temporal variance per colour of a pair of frames; EMVA 1288 equations 16 and 17."""
    first, second = (session.frame(capture).astype(np.float64) for capture in step.captures)
    channels = cfa_named(session.rig.camera.cfa).channel_map(*first.shape)
    masks = [channels == c for c in range(_CHANNELS)]
    mean = [0.5 * float((first[m] + second[m]).mean()) for m in masks]
    variance = [0.5 * float((first[m] - second[m]).var()) for m in masks]
    return np.array([mean, variance])
