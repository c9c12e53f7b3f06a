"""A picture on a plane in front of the panel, sampled without aliasing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32, Float64

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
    slopes: Float[np.ndarray, "rows columns 2"],
    render: Callable[[Float32[np.ndarray, "rows columns 2"]], Float[np.ndarray, "rows columns *colours"]],
) -> Float64[np.ndarray, "rows columns *colours"]:
    """Return the mean of ``render(slopes)`` over rays spread evenly over each pixel.

    Args:
        slopes: of the rays of the pixels' centres. Within a pixel they are linear to some 1e-5 px.
        render: returns the light of rays.
    """
    offsets = [(index + 0.5) / SUPERSAMPLING - 0.5 for index in range(SUPERSAMPLING)]
    centre = slopes.astype(np.float32)
    across, down = (np.gradient(slopes, axis=axis).astype(np.float32) for axis in (1, 0))
    total = np.zeros(())
    for dy in offsets:
        row = centre + dy * down
        for dx in offsets:
            total = total + render(row + dx * across)
    return total / SUPERSAMPLING**2
