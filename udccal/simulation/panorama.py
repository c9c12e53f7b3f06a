"""A perspective picture from an equirectangular panorama."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float


def panorama_view(
    equirect: Float[np.ndarray, "height width 3"],
    yaw_deg: float,
    pitch_deg: float,
    hfov_deg: float,
    columns: int,
    rows: int,
) -> Float[np.ndarray, "rows columns 3"]:
    """Return the linear picture that a pinhole camera takes of a panorama.

    Args:
        equirect: linear colours; the middle column is straight ahead, the top row straight up.
        yaw_deg: turn to the right.
        pitch_deg: turn upwards.
        hfov_deg: horizontal field of view, below 180.
        columns: columns of the picture. rows: rows of the picture.
    """
    focal = columns / 2 / np.tan(np.deg2rad(hfov_deg) / 2)
    source = _shrunk(equirect, 2 * np.pi * focal)
    x, y = np.meshgrid((np.arange(columns) - (columns - 1) / 2) / focal, (np.arange(rows) - (rows - 1) / 2) / focal)
    pitch = np.deg2rad(pitch_deg)
    ahead = np.cos(pitch) + y * np.sin(pitch)
    down = y * np.cos(pitch) - np.sin(pitch)
    longitude = np.arctan2(x, ahead) + np.deg2rad(yaw_deg)
    latitude = np.arctan2(down, np.hypot(x, ahead))
    height, width = source.shape[:2]
    column = np.mod((longitude / (2 * np.pi) + 0.5) * width - 0.5, width)
    row = np.clip((latitude / np.pi + 0.5) * height - 0.5, 0, height - 1)
    wrapped = cv2.copyMakeBorder(source, 0, 0, 2, 2, cv2.BORDER_WRAP)
    picture = cv2.remap(
        wrapped,
        (column + 2).astype(np.float32),
        row.astype(np.float32),
        cv2.INTER_CUBIC,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return np.maximum(picture, 0.0).astype(np.float64)


def _shrunk(equirect: Float[np.ndarray, "height width 3"], width_wanted: float) -> Float[np.ndarray, "h w 3"]:
    """Average the panorama down to the resolution of the view, if it is finer."""
    height, width = equirect.shape[:2]
    factor = min(1.0, width_wanted / width)
    size = (max(4, round(width * factor)), max(4, round(height * factor)))
    return cv2.resize(np.ascontiguousarray(equirect, np.float32), size, interpolation=cv2.INTER_AREA)
