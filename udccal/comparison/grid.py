"""Places on the sensor at which profiles are compared."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from udccal.rig import RigDescription

ACROSS, DOWN = 25, 19
_KERNELS = ((0.15, 0.2), (0.85, 0.3), (0.5, 0.55), (0.2, 0.85))


def sensor_grid(rig: RigDescription) -> Float[np.ndarray, "n 2"]:
    """Return (x, y) in px of ``DOWN`` x ``ACROSS`` places from edge to edge, row by row."""
    x, y = np.linspace(0, rig.camera.columns - 1.0, ACROSS), np.linspace(0, rig.camera.rows - 1.0, DOWN)
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def kernel_places(rig: RigDescription) -> Float[np.ndarray, "places 2"]:
    """Return the whole pixels (x, y) at which kernels are compared."""
    return np.floor(np.array(_KERNELS) * [rig.camera.columns - 1, rig.camera.rows - 1])


def light_step(rig: RigDescription) -> int:
    """Return the spacing in px of the grid on which the panel's light is compared: some 64 places across."""
    return max(1, rig.camera.columns // 64)
