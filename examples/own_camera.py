"""Capture with a camera of your own: a class with the members of ``udccal.cameras.protocol.Camera``.

python examples/own_camera.py        # here the camera is a sensor made of random numbers; its noise is fitted
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator

import numpy as np

import udccal
from udccal.arrangements import Arrangement, FlatLight, Occasion
from udccal.benches.bench import CaptureBench, simulated_rig
from udccal.cameras.protocol import CameraIdentity, Counts, Features, Frame, Mode, Range, Region, Settings, Trigger
from udccal.displays.simulated import SimulatedDisplay

RIG = udccal.load_rig("lg55-reduced")
RIG = RIG.model_copy(update={"camera": RIG.camera.model_copy(update={"columns": 128, "rows": 96})})
K_DN_PER_E, BLACK_DN, READ_E, LIGHT_E_PER_S = 0.35, 62.0, 5.2, 4e5


class MyCamera:  # makes its frames up; yours asks its driver. It is the Stage too: it switches its own light
    identity, sensor = CameraIdentity("Mine", "M-1", "0001", "own"), Region(0, 0, 128, 96)
    cfa, bits, mode, counts, lit, clock_s = "RGGB", 12, Mode("BayerRG12"), Counts(), False, 0.0
    rng, number = np.random.default_rng(0), 0
    features = Features(Range(1e-5, 30), Range(0, 0), Range(0.1, 60), ("BayerRG12",), (Trigger.SOFTWARE,), (2, 2, 2, 2))

    def __enter__(self) -> MyCamera:
        return self

    def __exit__(self, *_: object) -> None: ...
    def set_mode(self, mode: Mode) -> Mode:
        return mode

    def configure(self, settings: Settings) -> Settings:
        self.settings = settings
        return settings

    def frames(self, count: int) -> Iterator[Frame]:
        part, seconds = self.settings.region, self.settings.exposure_s
        for _ in range(count):
            self.clock_s, self.number = self.clock_s + seconds, self.number + 1
            electrons = self.rng.poisson(self.lit * LIGHT_E_PER_S * seconds, (part.rows, part.columns))
            signal = K_DN_PER_E * (electrons + READ_E * self.rng.standard_normal(electrons.shape))
            data = np.clip(np.rint(BLACK_DN + signal), 0, 4095).astype(np.uint16)
            yield Frame(data, self.settings, self.clock_s, self.number, complete=True)

    def arrange(self, arrangement: Arrangement, occasion: Occasion) -> None:
        self.lit = isinstance(arrangement, FlatLight)


world = simulated_rig(RIG, 0)
with MyCamera() as camera, SimulatedDisplay(world) as display, tempfile.TemporaryDirectory() as folder:
    bench = CaptureBench(RIG, camera, display, camera, world.now)
    noise = udccal.fit(udccal.capture(f"{folder}/session", bench, terms=["noise"]), "noise")
for one, truth in zip(noise.estimates, (K_DN_PER_E, BLACK_DN), strict=False):
    print(f"{noise.status.name}: {one.name} {one.value:.4f} ± {one.sigma:.4f} of {truth}")
