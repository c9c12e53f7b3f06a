"""A picture on a plane in front of the panel, sampled without aliasing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32

# Every pixel of a rendered view is the mean of this many samples per axis.
SUPERSAMPLING = 3


@dataclass(frozen=True)
class PlanePicture:
    """Linear colours on a plane: texel centres at ``origin_mm`` + (column, row) * ``texel_mm``, mirrored outside."""

    texels: Float32[np.ndarray, "texel_rows texel_columns 3"]
    texel_mm: Float[np.ndarray, "2"]
    origin_mm: Float[np.ndarray, "2"]

    def at(self, points_mm: Float[np.ndarray, "rows columns 2"]) -> Float[np.ndarray, "rows columns 3"]:
        """Return the colour at points of the plane, by bicubic interpolation, never negative."""
        texel = ((points_mm - self.origin_mm) / self.texel_mm).astype(np.float32)
        colours = cv2.remap(self.texels, texel[..., 0], texel[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
        return np.maximum(colours, 0.0).astype(np.float64)


def place_picture(
    radiance: Float[np.ndarray, "rows columns 3"],
    width_mm: float,
    centre_mm: Float[np.ndarray, "2"],
    sample_mm: float,
) -> PlanePicture:
    """Place a picture ``width_mm`` wide, centred at ``centre_mm``, with texels no finer than ``sample_mm``.

    Shrinking averages over area, so that detail too fine for the samples does not alias.
    """
    rows, columns = radiance.shape[:2]
    factor = min(1.0, width_mm / columns / sample_mm)
    size = (max(2, round(columns * factor)), max(2, round(rows * factor)))
    texels = cv2.resize(np.ascontiguousarray(radiance, np.float32), size, interpolation=cv2.INTER_AREA)
    extent = np.array([width_mm, width_mm * rows / columns])
    texel_mm = extent / size
    return PlanePicture(texels=texels, texel_mm=texel_mm, origin_mm=centre_mm - extent / 2 + texel_mm / 2)


def supersample(
    render: Callable[[float, float], Float[np.ndarray, "rows columns *colours"]],
) -> Float[np.ndarray, "rows columns *colours"]:
    """Return the mean of ``render(dx, dy)`` over sample points (dx, dy) spread evenly over a pixel."""
    offsets = (np.arange(SUPERSAMPLING) + 0.5) / SUPERSAMPLING - 0.5
    total = render(float(offsets[0]), float(offsets[0]))
    for index in range(1, SUPERSAMPLING**2):
        total += render(float(offsets[index % SUPERSAMPLING]), float(offsets[index // SUPERSAMPLING]))
    return total / SUPERSAMPLING**2
