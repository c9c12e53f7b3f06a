"""The wire: flats, which are averaged frame by frame, and pixels, all of which go into the fit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from tests.benchmarks.growth.cases import Case
from tests.scenes.wire import PRNU, SITES, geometry, start
from udccal.fitting.wire.data import WireData
from udccal.fitting.wire.fit import fit_wire
from udccal.fitting.wire.parameters import WireRules, ideal_wire, possible_harmonics
from udccal.models.geometry import Geometry
from udccal.models.wire import wire_map
from udccal.numerics import in_float64
from udccal.sessions.averaging import RunningMoments

_PIXELS, _FLATS = 38_400, 100
# DN of the brightest site in one frame, at one electron per DN.
_LEVEL = 3000.0
# Frames are drawn so many at a time and taken again and again: drawing them is no part of the work.
_DRAWN = 10


def _lens(rows: int) -> Geometry:
    """That of the efficiency benchmark, on a sensor of other pixels."""
    lens, by = geometry(), rows / 120
    return replace(lens, focal_px=lens.focal_px * by, principal_point_px=(lens.principal_point_px + 0.5) * by - 0.5)


@in_float64
def _work(flats: int, pixels: int) -> Callable[[], object]:
    rows = 2 * round(np.sqrt(0.75 * pixels) / 2)
    columns = 2 * round(pixels / rows / 2)
    lens, built = _lens(rows), start()
    harmonics = possible_harmonics(built).orders
    shape = np.asarray(wire_map(ideal_wire(lens, built, harmonics), rows, columns), dtype=np.float64)
    rng = np.random.default_rng(1)
    light = _LEVEL * shape / shape.mean() * np.tile(SITES, (rows // 2, columns // 2))
    light *= 1 + PRNU * rng.standard_normal(light.shape)
    frames = rng.poisson(light, (_DRAWN, rows, columns)).astype(np.uint16)

    def work() -> object:
        moments = RunningMoments(rows, columns)
        for number in range(flats):
            moments.add(frames[number % _DRAWN])
        signal = moments.mean().astype(np.float64)
        # The frames that are taken again are the same.
        variance = moments.variance().astype(np.float64) / min(flats, _DRAWN)
        data = WireData(signal, variance, lens, built, PRNU)
        return fit_wire(data, WireRules(samples=signal.size)).or_raise()

    return work


CASES = (
    Case("wire", "flats", (50, 100, 200), lambda flats: _work(flats, _PIXELS)),
    Case("wire", "pixels", (19_200, 38_400, 76_800), lambda pixels: _work(_FLATS, pixels)),
)
