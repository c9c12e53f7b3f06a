"""Captured data of a step before it is stored."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from udccal.cameras.protocol import Frame, Settings
from udccal.sessions.schema import Rejection


@dataclass(frozen=True)
class SingleFrame:
    """One frame exactly as the camera delivered it, and the frames rejected before it."""

    frame: Frame
    rejected: tuple[Rejection, ...] = ()


@dataclass(frozen=True)
class AveragedFrames:
    """Mean in DN and unbiased variance in DN^2 of single frames, with their settings, times and temperature."""

    mean: Float32[np.ndarray, "rows columns"]
    variance: Float32[np.ndarray, "rows columns"]
    frames: int
    settings: Settings
    first_timestamp_s: float
    last_timestamp_s: float
    rejected: tuple[Rejection, ...] = ()
    temperature_C: float | None = None


Capture = SingleFrame | AveragedFrames
