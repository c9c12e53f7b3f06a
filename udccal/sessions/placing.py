"""Writing captured data to a session's folder, one whole file each."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import UInt8

from udccal.cameras.protocol import Region
from udccal.errors import SessionError
from udccal.io.exr import write_exr
from udccal.io.hashing import sha256_file
from udccal.io.links import make_folder
from udccal.io.png import write_png16, write_rgb8
from udccal.sessions.captured import AveragedFrames, Capture, SingleFrame
from udccal.sessions.schema import RELATIVE_PATH, PanelSubject, StoredCapture, StoredRegion


def place_capture(folder: Path, stem: str, capture: Capture) -> StoredCapture:
    """Write a frame or an average; a file of that name is replaced.

    Raises:
        SessionError: when the stem is not a valid step id.
        OSError: when the disk is full or cannot be written to.
    """
    match capture:
        case SingleFrame(frame, rejected):
            name, frames, settings = f"{stem}.png", 1, frame.settings
            first_s = last_s = frame.timestamp_s
            temperature_C = frame.temperature_C
            write_png16(_place(folder, name), frame.data)
        case AveragedFrames(mean, variance, frames, settings, first_s, last_s, rejected, temperature_C):
            name = f"{stem}.exr"
            write_exr(_place(folder, name), {"mean": mean, "variance": variance})
    return StoredCapture(
        kind="frame" if isinstance(capture, SingleFrame) else "average",
        file=name,
        sha256=sha256_file(folder / name),
        frames=frames,
        exposure_s=settings.exposure_s,
        gain_dB=settings.gain_dB,
        region=_stored_region(settings.region),
        first_timestamp_s=first_s,
        last_timestamp_s=last_s,
        rejected=rejected,
        temperature_C=temperature_C,
    )


def place_picture(
    folder: Path,
    step_id: str,
    picture: UInt8[np.ndarray, "panel_rows panel_columns 3"],
    role: Literal["white", "picture", "brightened"],
) -> PanelSubject:
    """Write what the panel shows during a step; raises as ``place_capture``."""
    name = f"{step_id}_shown.png"
    write_rgb8(_place(folder, name), picture)
    return PanelSubject(picture=name, picture_sha256=sha256_file(folder / name), role=role)


def _place(folder: Path, name: str) -> Path:
    if not re.fullmatch(RELATIVE_PATH, name):
        raise SessionError(f"Expected a step id of letters, digits, '_', '-' and '/', found a file name '{name}'.")
    file = folder / name
    make_folder(folder, file.parent)
    return file


def _stored_region(region: Region) -> StoredRegion:
    return StoredRegion(x=region.x, y=region.y, columns=region.columns, rows=region.rows)
