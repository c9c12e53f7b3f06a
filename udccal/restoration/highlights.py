"""Light that clips: how bright it must be to make its streaks, solved for, and taken out of the mosaic.

A clipped sample tells only that the light was brighter. But a light behind the panel has streaks as long as the kernel,
far beyond a tile, and these are data. So each colour is solved over the whole frame without its clipped samples
(deblur.py). What the solution holds above the sensor's range is blurred again and taken out of the mosaic. The rest no
longer clips, and reaches no farther than its tile.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Bool, Float32

from udccal.cfa import cfa_named
from udccal.restoration.deblur import Deblurrer, expected_smoothness
from udccal.restoration.demosaic import demosaic_clipped
from udccal.restoration.lowrank import KernelGrid
from udccal.restoration.plan import PlanOptions, build_deblurrers
from udccal.rig import RigDescription

Mosaic = Float32[np.ndarray, "rows columns"]


@final
@dataclass(frozen=True)
class Highlights:
    """One solver per colour over the whole frame."""

    deblurrers: tuple[Deblurrer, ...]
    cfa: str
    contrast: float

    @classmethod
    def of(cls, grid: KernelGrid, rig: RigDescription, options: PlanOptions) -> Highlights:
        """Prepare the solvers."""
        return cls(build_deblurrers(grid, rig, options), rig.camera.cfa, options.contrast)

    def taken_out(
        self, signal_e: Mosaic, clipped: Bool[np.ndarray, "rows columns"], variance_e2: float
    ) -> tuple[Mosaic, Float32[np.ndarray, "rows columns 3"]]:
        """Return the mosaic as it would be without light above the range, and that light, in e-.

        Args:
            signal_e: signal in e-, without backscatter.
            clipped: samples that are saturated; at least one.
            variance_e2: mean variance of the noise in e-^2.
        """
        top = np.float32(np.median(signal_e[clipped]))
        blurred, valid = demosaic_clipped(signal_e, self.cfa, clipped)
        bright, seen = np.empty_like(blurred), np.empty_like(blurred)
        unclipped = np.empty_like(blurred)
        for channel, deblurrer in enumerate(self.deblurrers):
            plane, known = np.ascontiguousarray(blurred[..., channel]), np.ascontiguousarray(valid[..., channel])
            smoothness = expected_smoothness(plane, variance_e2, self.contrast)
            sharp = deblurrer.solve(plane, known, smoothness).picture
            canvas, blur = deblurrer.blur.canvas, deblurrer.blur
            bright[..., channel] = np.maximum(sharp - top, 0)
            unclipped[..., channel] = canvas.frame(blur.forward(canvas.extended(np.minimum(sharp, top))))
            padded = np.zeros((canvas.rows, canvas.columns), dtype=np.float32)
            canvas.frame(padded)[:] = bright[..., channel]
            seen[..., channel] = canvas.frame(blur.forward(padded))
        own = cfa_named(self.cfa).channel_map(*signal_e.shape)[..., None]
        seen_here = np.take_along_axis(seen, own, axis=2)[..., 0]
        expected = np.take_along_axis(unclipped, own, axis=2)[..., 0]
        return np.where(clipped, expected, signal_e - seen_here), bright
