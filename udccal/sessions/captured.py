"""What a step has captured, on its way to disk."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from udccal.cameras.protocol import Frame, Settings
from udccal.sessions.schema import Rejection


@dataclass(frozen=True)
class SingleFrame:
    """One frame exactly as the camera delivered it, and the frames left out before it."""

    frame: Frame
    rejected: tuple[Rejection, ...] = ()


@dataclass(frozen=True)
class AveragedFrames:
    """Mean and unbiased variance of single frames in DN and DN^2, with what is needed to store them."""

    mean: Float32[np.ndarray, "rows columns"]
    variance: Float32[np.ndarray, "rows columns"]
    frames: int
    settings: Settings
    first_timestamp_s: float
    last_timestamp_s: float
    rejected: tuple[Rejection, ...] = ()


Capture = SingleFrame | AveragedFrames
