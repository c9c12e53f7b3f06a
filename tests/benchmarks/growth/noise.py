"""The noise fit from frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from tests.benchmarks.growth.cases import Case
from tests.scenes.noise import ToySensor, expose, patterns
from udccal.fitting.noise.data import ExposureLevel, NoiseData, SpatialStack
from udccal.fitting.noise.fit import fit_noise

_COLUMNS, _ROWS, _LEVELS, _STACK = 2048, 384, 10, 8


def _work(levels: int, stack: int, rows: int) -> Callable[[], object]:
    sensor = replace(ToySensor(), rows=rows, columns=_COLUMNS, bend=0.0, lambda_read=None)
    rng = np.random.default_rng(1)
    shoot = partial(expose, sensor, patterns(sensor, rng), rng=rng)
    times = [sensor.exposure_s(level) for level in np.linspace(0.05, 1.1, levels)]
    pairs = [ExposureLevel(t, (shoot(t, False), shoot(t, False)), (shoot(t, True), shoot(t, True))) for t in times]
    t = sensor.exposure_s(sensor.stack_level)
    dark, bright = ([shoot(t, lit) for _ in range(stack)] for lit in (False, True))
    return lambda: fit_noise(NoiseData(pairs, SpatialStack(t, dark, bright), top_code=2**sensor.bits - 1))


CASES = (
    Case("noise", "exposure levels, 2 dark and 2 bright frames each", (5, 10, 20), lambda n: _work(n, _STACK, _ROWS)),
    Case("noise", "frames per stack", (8, 16, 32), lambda n: _work(_LEVELS, n, _ROWS)),
    Case("noise", "rows of 2048 pixels", (384, 768, 1536), lambda n: _work(_LEVELS, _STACK, n)),
)
