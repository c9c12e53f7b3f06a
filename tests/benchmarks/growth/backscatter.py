"""Fits of the backscatter term: light follows the model, so that data of any size are quickly made."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tests.benchmarks.growth.cases import Case
from tests.scenes.backscatter import panel_pictures, shots_of, small_rig, world_at
from udccal.fitting.backscatter.fit import fit_backscatter
from udccal.fitting.backscatter.parameters import BackscatterRules, prior_of
from udccal.rig import RigDescription

_PICTURES, _POSITIONS, _COLUMNS = 12, 96, 384


def _rig(columns: int) -> RigDescription:
    """The same field on a sensor of that many columns: pixels are the smaller, the more there are."""
    rig = small_rig()
    pitch_um = rig.camera.pitch_um * rig.camera.columns / columns
    camera = rig.camera.model_copy(update={"columns": columns, "rows": 3 * columns // 4, "pitch_um": pitch_um})
    return rig.model_copy(update={"camera": camera})


def _work(pictures: int, positions: int, columns: int) -> Callable[[], object]:
    rig, rng = _rig(columns), np.random.default_rng(1)
    of = world_at(prior_of(rig).mean, rig, np.array([1.6e4, 2e4, 1.4e4])[:, None, None])
    data = shots_of(of, rng, panel_pictures(rig, 0, pictures))
    return lambda: fit_backscatter(data, of.term.geometry, rig, BackscatterRules(positions=positions))


CASES = (
    Case("backscatter", "pictures", (8, 16, 32), lambda pictures: _work(pictures, _POSITIONS, _COLUMNS)),
    Case("backscatter", "positions", (48, 96, 192), lambda positions: _work(_PICTURES, positions, _COLUMNS)),
    Case("backscatter", "columns of pixels", (384, 768, 1536), lambda columns: _work(_PICTURES, _POSITIONS, columns)),
)
