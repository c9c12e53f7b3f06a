"""Merging brackets."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tests.benchmarks.efficiency.hdr import sensor
from tests.benchmarks.growth.cases import Case
from udccal.fitting.hdr.merge import merge_bracket

_COLUMNS, _ROWS, _FRAMES = 2048, 384, 10


def _work(frames: int, rows: int) -> Callable[[], object]:
    times = 1e-4 * 10 ** np.linspace(0, 3, frames)
    rate = np.geomspace(1e3, 1e7, rows * _COLUMNS).reshape(rows, _COLUMNS)
    rng = np.random.default_rng(1)
    stack = np.empty((frames, rows, _COLUMNS), np.uint16)
    for frame, time in zip(stack, times, strict=True):
        frame[:] = np.clip(np.rint(64 + 0.36 * (rng.poisson(rate * time) + 4.0)), 0, 4095)
    return lambda: merge_bracket(stack, times, sensor())


CASES = (
    Case("hdr", "frames", (5, 10, 20), lambda frames: _work(frames, _ROWS)),
    Case("hdr", "rows of 2048 pixels", (384, 768, 1536), lambda rows: _work(_FRAMES, rows)),
)
