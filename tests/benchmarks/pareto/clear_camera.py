"""The same camera without a panel: what is left to gain of a scene."""

from __future__ import annotations

import numpy as np

from tests.benchmarks.pictures import PictureBench, Rgb, Shot, displayed
from udccal.restoration.demosaic import demosaic
from udccal.restoration.linear import to_electrons
from udccal.simulation.scene import WHITE_E_PER_S, render_photograph


def without_panel(bench: PictureBench, shot: Shot, room_light: float) -> Rgb:
    """The display-encoded picture of a camera that no panel blurs, stripes or lights, on the same view.

    Its exposure fills the well as far as with a panel. The mosaic is demosaiced (Malvar). Defects stay: their light is
    small, and what finds them would take points of light for defects, which no panel spreads here.
    """
    light = render_photograph(bench.truth, shot.photograph) * (shot.gain * WHITE_E_PER_S * room_light)
    exposure_s = bench.filling_s(room_light * WHITE_E_PER_S)
    frame = bench.exposed(bench.mosaic(light).astype(np.float32), exposure_s, shot.name)
    restorer = bench.restorer
    sensor_e = demosaic(to_electrons(frame, restorer.noise, exposure_s), restorer.rig.camera.cfa)
    return displayed(restorer.rectification.apply(sensor_e) / np.float32(exposure_s), shot, room_light)
