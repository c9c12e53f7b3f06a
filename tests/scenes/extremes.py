"""Rigs and frames at the edge of what can be, each with a step of light that no picture may overshoot.

Where a step is as weak as the noise, frames of several draws are averaged, and the overshoot is a part of the noise of
one sample: a smaller one is not seen.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float32, UInt16

from tests.scenes import toy_restorer
from tests.scenes.toy_restorer import COLUMNS, EXPOSURE_S, NOISE, ROWS, made, recorded_e, taken
from udccal.cfa import cfa_named
from udccal.restoration.deblur import deblur
from udccal.restoration.kernel_grid import KernelGrid
from udccal.restoration.panel_mask import PanelMask
from udccal.restoration.runtime import Restorer
from udccal.rig import RigDescription
from udccal.tiers import Tier

# Overshoot of a step, as a part of its height.
MOST_OVERSHOOT = 0.08
SATURATION_DN = 3969
# Draws of the noise that are averaged where it hides a step.
_DRAWS = 64
# Where a lamp or hot columns are on the sensor, and from which column of the view on a picture must not show them.
_SIDE_PX, _BESIDE_PX = 8, 24

Frame = UInt16[np.ndarray, "rows columns"]
Picture = Float32[np.ndarray, "rows columns 3"]


def step(axis: int, low: float, high: float, rows: int = ROWS, columns: int = COLUMNS, at: int = 0) -> Picture:
    """A scene in e- of two levels.

    Args:
        axis: 0 where the light rises across the picture, 1 where it rises down.
        low: of the left or upper part. high: of the other one.
        rows: of the sensor. columns: of the sensor.
        at: px from the middle.
    """
    scene = np.full((rows, columns, 3), low, np.float32)
    if axis == 0:
        scene[:, columns // 2 + at :] = high
    else:
        scene[rows // 2 + at :] = high
    return scene


def overshoot(picture: np.ndarray, axis: int, low: float, high: float, unit: float = 0.0) -> float:
    """How far a picture of a step goes beyond it, as a part of its height, or of ``unit`` where that is more.

    It is that of the mean of all places at one distance from the edge, so that noise does not count. Not a number where
    a picture has one that is not finite.

    Args:
        picture: of the step.
        axis: along which places are alike.
        low: level of the step. high: level of the step.
        unit: of the overshoot, at least.
    """
    if not np.isfinite(picture).all():
        return float("nan")
    along = picture.mean(axis=axis)
    return float(max(along.max() - high, low - along.min(), 0.0) / max(high - low, unit))


@dataclass(frozen=True)
class Extreme:
    """A rig, what it sees, and what befalls the frame.

    Attributes:
        name: for a table.
        low, high: the step in e-.
        rig, grid, wire: where they are not the toy rig's own.
        panel_e: light of a white panel, whose picture is not known, in e-.
        seen: changes the scene before it is taken. befallen: changes the frame.
        draws: frames that are averaged.
        unit_e: see ``overshoot``.
        first_column: of the view that is looked at.
    """

    name: str
    low: float = 500.0
    high: float = 5000.0
    rig: RigDescription = field(default_factory=toy_restorer.rig)
    grid: KernelGrid = field(default_factory=toy_restorer.grid)
    wire: Float32[np.ndarray, "rows columns"] | None = None
    panel_e: float = 0.0
    seen: Callable[[Picture], None] = lambda _: None
    befallen: Callable[[Frame], None] = lambda _: None
    draws: int = 1
    unit_e: float = 0.0
    first_column: int = 0

    def restorer(self, tier: Tier) -> Restorer:
        """Of the toy rig under these conditions."""
        camera = self.rig.camera
        restorer = made(tier, self.rig, NOISE, toy_restorer.geometry(), self.grid)
        light = np.full((camera.rows, camera.columns), self.panel_e / EXPOSURE_S, np.float32)
        return replace(
            restorer,
            wire=restorer.wire if self.wire is None else self.wire,
            mask=PanelMask(light, cfa_named(camera.cfa)) if self.panel_e else None,
        )

    def frames(self, restorer: Restorer, axis: int) -> Iterator[Frame]:
        """Frames of the step along an axis (``step``), each with other noise."""
        camera = self.rig.camera
        scene = step(axis, self.low, self.high, camera.rows, camera.columns)
        self.seen(scene)
        signal_e = recorded_e(restorer, self.grid, scene + np.float32(self.panel_e))
        for seed in range(1, self.draws + 1):
            frame = taken(restorer, signal_e, seed)
            self.befallen(frame)
            yield frame

    def overshoot(self, restorer: Restorer) -> float:
        """The larger of both axes; not a number where a picture is not finite."""
        found = []
        for axis in (0, 1):
            pictures = [restorer.restore(frame, EXPOSURE_S) for frame in self.frames(restorer, axis)]
            mean = np.mean(pictures, axis=0)[:, self.first_column :] * EXPOSURE_S
            found.append(overshoot(mean, axis, self.low, self.high, self.unit_e))
        # NaN is the largest.
        return float(np.max(found))


def extremes() -> list[Extreme]:
    """All of them but the crop of one pixel, which is no frame (``overshoot_of_a_pixel``)."""
    dark = Extreme("signals of 1 e-", 0.0, 1.0, draws=_DRAWS, unit_e=float(NOISE.sigma_d_e))
    patch = np.ones((ROWS, COLUMNS), np.float32)
    patch[30:50, 40:70] = 1e-3
    rows = np.ones((ROWS, COLUMNS), np.float32)
    rows[20:24] = 1e-4
    return [
        Extreme("transmittance 1 %", wire=np.full((ROWS, COLUMNS), 0.01, np.float32), draws=_DRAWS),
        Extreme("wire near zero, a patch", wire=patch),
        Extreme("wire near zero, four rows", wire=rows),
        Extreme("a transfer with zeros", grid=_two_peaks()),
        Extreme("90 % saturated", high=3 * SATURATION_DN / NOISE.K_DN_per_e, seen=_bright_nine_tenths),
        replace(dark, name="a black frame", high=0.0),
        dark,
        replace(
            dark,
            name="a peak a million times the median, beside it",
            low=0.005,
            high=0.015,
            seen=_lamp,
            first_column=_BESIDE_PX,
        ),
        Extreme("three hot columns, beside them", befallen=_hot_columns, first_column=_BESIDE_PX),
        *(
            Extreme(f"odd size, {rows} x {columns}", rig=_sized(rows, columns))
            for rows, columns in ((95, 127), (97, 129))
        ),
        *(Extreme(f"pattern {cfa}", rig=_patterned(cfa)) for cfa in ("RGGB", "BGGR", "GRBG", "GBRG")),
        Extreme("a panel brighter than the scene", 0.0, 100.0, panel_e=1000.0, draws=_DRAWS),
    ]


def overshoot_of_a_pixel(tier: Tier) -> float:
    """How far one pixel, deblurred, is from its own light, as a part of it; the preview does not deblur."""
    if tier is Tier.preview:
        return 0.0
    grid = toy_restorer.grid()
    one = np.full((1, 1, 3), 7.0, np.float32)
    return float(np.abs(deblur(one, grid.kernels[:1, :1], np.zeros(1), np.zeros(1), tier=tier) / one - 1).max())


def _two_peaks() -> KernelGrid:
    """Two equal peaks swallow every frequency at which they cancel."""
    grid = toy_restorer.grid()
    kernels = np.zeros_like(grid.kernels)
    kernels[..., 16, 4] = kernels[..., 24, 4] = 0.5
    return replace(grid, kernels=kernels)


def _sized(rows: int, columns: int) -> RigDescription:
    rig = toy_restorer.rig()
    return rig.model_copy(update={"camera": rig.camera.model_copy(update={"rows": rows, "columns": columns})})


def _patterned(cfa: str) -> RigDescription:
    rig = toy_restorer.rig()
    return rig.model_copy(update={"camera": rig.camera.model_copy(update={"cfa": cfa})})


def _bright_nine_tenths(scene: Picture) -> None:
    """Leave a tenth of a step dark."""
    across = np.ptp(scene[0, :, 0]) > 0
    high = scene.max()
    if across:
        scene[:, scene.shape[1] // 10 :] = high
    else:
        scene[scene.shape[0] // 10 :] = high


def _lamp(scene: Picture) -> None:
    scene[46:48, _SIDE_PX : _SIDE_PX + 2] = 1e4


def _hot_columns(frame: Frame) -> None:
    frame[:, _SIDE_PX : _SIDE_PX + 9 : 4] = SATURATION_DN
