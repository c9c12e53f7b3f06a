"""Where a virtual camera's light comes from: a small callable that makes the mosaic of one exposure."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import UInt16

from udccal.cameras.protocol import Region, Settings

PATTERN_PERIOD = 4


@dataclass(frozen=True)
class Exposure:
    """What the camera does for one frame.

    Attributes:
        block_id: the frame's number in its acquisition.
        start_ns: on the camera's clock.
        bits: of the converter.
        x, y, columns, rows: the region.
    """

    block_id: int
    start_ns: int
    exposure_us: float
    gain_steps: int
    bits: int
    x: int
    y: int
    columns: int
    rows: int

    @property
    def settings(self) -> Settings:
        """In the project's terms."""
        region = Region(self.x, self.y, self.columns, self.rows)
        return Settings(self.exposure_us * 1e-6, self.gain_steps / 10, region)


FrameSource = Callable[[Exposure], UInt16[np.ndarray, "rows columns"]]


@final
class PatternSource:
    """A pattern in which every sample identifies its place, and every frame (but each fourth) differs from the others.

    Frames are remembered and read-only, so that a camera that runs for long need not compute them again.
    """

    def __init__(self) -> None:
        self._made: dict[tuple[int, int, int, int, int, int], UInt16[np.ndarray, "rows columns"]] = {}

    def __call__(self, exposure: Exposure) -> UInt16[np.ndarray, "rows columns"]:
        phase = exposure.block_id % PATTERN_PERIOD
        key = (phase, exposure.bits, exposure.x, exposure.y, exposure.columns, exposure.rows)
        if key not in self._made:
            if len(self._made) >= 2 * PATTERN_PERIOD:
                self._made.clear()
            self._made[key] = _pattern(*key)
        return self._made[key]


def _pattern(phase: int, bits: int, x: int, y: int, columns: int, rows: int) -> UInt16[np.ndarray, "rows columns"]:
    down = (np.arange(y, y + rows, dtype=np.uint32) * np.uint32(2654435761))[:, None]
    across = np.arange(x, x + columns, dtype=np.uint32) * np.uint32(40503) + np.uint32(phase * 7919)
    mixed = (down + across) * np.uint32(2246822519)  # wraps around at 32 bits, of which the highest are kept
    mosaic = (mixed >> np.uint32(32 - bits)).astype(np.uint16)
    mosaic.flags.writeable = False
    return mosaic
