"""How the cost of a frame grows: the exponent of CPU time against pixels, tiles and frames.

For pixels, the rig is cut to a half and to a quarter of its sensor: the same kernels, and a view that covers the same
part of what is left.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from tests.benchmarks.pareto.restoring import Setup, Taken
from tests.benchmarks.rows import Row, at_most
from udccal.cfa import cfa_named
from udccal.restoration.mosaic_filter import filtered
from udccal.restoration.panel_mask import PanelMask
from udccal.restoration.plan import PlanOptions
from udccal.restoration.rectify import Rectification
from udccal.restoration.runtime import Restorer
from udccal.restoration.sharpen import Sharpener
from udccal.restoration.tone import Tone
from udccal.tiers import Tier

_MOST: Final = 1.1
# Parts of the sensor's height and width.
_CUTS: Final = ((1.0, 1.0), (0.5, 1.0), (0.5, 0.5))
_FRAMES: Final = (1, 2, 4)
_TIMES: Final = 3


@dataclass(frozen=True)
class Growth:
    """CPU seconds of a piece of work at several sizes of it."""

    name: str
    sizes: tuple[float, ...]
    seconds: tuple[float, ...]

    @property
    def exponent(self) -> float:
        """The slope of a line through log seconds over log size.

        Raises:
            ValueError: when there are not two sizes to compare.
        """
        if len(set(self.sizes)) < 2:
            raise ValueError(f"Expected {self.name} at two sizes at least, found {self.sizes}.")
        return float(np.polyfit(np.log(self.sizes), np.log(self.seconds), 1)[0])


def growths_of(profile: str, taken: Taken, keep: Path) -> list[Growth]:
    """Measure a profile's growths.

    Args:
        profile: its path or name.
        taken: a frame.
        keep: folder of prepared arrays.
    """
    tiers = [_of_pixels(Setup(profile, tier, PlanOptions(), keep), taken) for tier in Tier]
    fast = Restorer.load(profile, Tier.fast, keep=keep)
    return [*tiers, _of_tiles(fast, taken), _of_frames(fast, taken)]


def growth_rows(growths: Sequence[Growth]) -> list[Row]:
    """No cost grows faster than its size, but for a tenth in the exponent."""
    return [at_most(f"exponent of cost, {growth.name}", growth.exponent, _MOST, "") for growth in growths]


def cut(restorer: Restorer, rows: int, columns: int) -> Restorer:
    """The restorer of the first rows and columns of its sensor, for panels of unknown pictures.

    Args:
        restorer: of the whole sensor.
        rows: of what is left, whole cells. columns: of what is left, whole cells.
    """
    camera = restorer.rig.camera
    rig = restorer.rig.model_copy(update={"camera": camera.model_copy(update={"rows": rows, "columns": columns})})
    down, across = rows / camera.rows, columns / camera.columns
    maps = restorer.rectification.map_x * np.float32(across), restorer.rectification.map_y * np.float32(down)
    size = round(restorer.view.columns * across), round(restorer.view.rows * down)
    rectification = Rectification(*(cv2.resize(each, size, interpolation=cv2.INTER_AREA) for each in maps))
    sharpener, mask = restorer.sharpener, restorer.mask
    if sharpener is not None:
        sharpener = Sharpener.of(sharpener.grid, rig, rectification.rows, restorer.tier, restorer.options)
    smaller = replace(restorer, rig=rig, panel=None, sharpener=sharpener, rectification=rectification)
    part = np.s_[: len(range(rows)[smaller.rows]), :columns]
    return replace(
        smaller,
        wire=None if restorer.wire is None else np.ascontiguousarray(restorer.wire[part]),
        mask=None if mask is None else PanelMask(np.ascontiguousarray(mask.white[part]), cfa_named(camera.cfa)),
    )


def _of_pixels(setup: Setup, taken: Taken) -> Growth:
    whole = Restorer.load(setup.profile, setup.tier, setup.options, setup.keep)
    sizes, seconds = [], []
    for down, across in _CUTS:
        rows, columns = (int(side * part / 2) * 2 for side, part in zip(taken.frame.shape, (down, across), strict=True))
        restorer, frame = cut(whole, rows, columns), np.ascontiguousarray(taken.frame[:rows, :columns])
        seconds.append(_least_cpu_s(lambda own=restorer, part=frame: _display(own, part, taken.exposure_s)))
        sizes.append(rows * columns)
    return Growth(f"{setup.tier} against pixels", tuple(sizes), tuple(seconds))


def _of_tiles(restorer: Restorer, taken: Taken) -> Growth:
    sharpener = restorer.sharpener
    assert sharpener is not None
    light = restorer.scene_light(taken.frame, taken.exposure_s, taken.panel_picture)
    noise_e = sharpener.solved(light.signal_e, light.variance_e2, light.clipped).noise_e
    tiles = sharpener.layout.cut(light.signal_e)
    counts = sorted({max(1, len(tiles) // 4), max(1, len(tiles) // 2), len(tiles)})

    def of(count: int) -> Callable[[], object]:
        some = np.arange(count)
        given = tiles[some], noise_e[some], sharpener.tables.at(sharpener.layout.kernel[some])
        return lambda: filtered(*given, sharpener.layout, sharpener.cfa)

    return Growth("filter against tiles", tuple(counts), tuple(_least_cpu_s(of(count)) for count in counts))


def _of_frames(restorer: Restorer, taken: Taken) -> Growth:
    def of(count: int) -> Callable[[], object]:
        return lambda: [_display(restorer, taken.frame, taken.exposure_s) for _ in range(count)]

    return Growth("fast against frames", _FRAMES, tuple(_least_cpu_s(of(count)) for count in _FRAMES))


def _display(restorer: Restorer, frame: np.ndarray, exposure_s: float) -> object:
    return restorer.display(frame, exposure_s, Tone(1e-6))


def _least_cpu_s(work: Callable[[], object]) -> float:
    """The least CPU seconds of some runs, after one that compiles."""
    work()
    seconds = []
    for _ in range(_TIMES):
        start = time.process_time()
        work()
        seconds.append(time.process_time() - start)
    return min(seconds)
