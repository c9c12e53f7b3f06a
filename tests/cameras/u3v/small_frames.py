"""Small frames of the virtual camera's pattern, and the shape of the driver's sentences."""

from __future__ import annotations

import numpy as np

from tests.virtual_u3v.sources import Exposure, PatternSource
from udccal.cameras.protocol import Frame, Region, Settings

SENTENCE = r"Expected .* found.*\. \w+"
REGION = Region(8, 4, 64, 48)
SETTINGS = Settings(4e-3, 3.0, REGION)


def pattern(frame: Frame, block_id: int, bits: int = 12) -> np.ndarray:
    region = frame.settings.region
    return PatternSource()(Exposure(block_id, 0, 4000.0, 0, bits, region.x, region.y, region.columns, region.rows))


def check_whole(frames: list[Frame], whole: dict[int, int]) -> None:
    """That of these frames those at the keys are complete, with the pattern of the block at the value."""
    assert [i for i, frame in enumerate(frames) if frame.complete] == list(whole)
    for i, block_id in whole.items():
        np.testing.assert_array_equal(frames[i].data, pattern(frames[i], block_id))
