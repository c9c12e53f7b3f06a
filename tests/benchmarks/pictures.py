"""Scenes seen through a simulated rig, restored with its profile, and compared with what a perfect camera sees.

What counts for "before" is the ratio of panel light to room light, so the PSNR of "before" is a dial. The panel stays
at the brightness it was calibrated at; the room's light is set, once for all scenes, so that the mean PSNR of "before"
is the paper's 21.5 dB. ``CONDITIONS`` are that light, and others beside it.
"""

from __future__ import annotations

import time
import zlib
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, UInt8, UInt16

from tests.benchmarks.scenes import Scene
from udccal.arrangements import Photograph
from udccal.cameras.protocol import Region
from udccal.cfa import cfa_named
from udccal.displays.pictures import face_picture
from udccal.restoration.metrics import display_exposure, encode_srgb, least_squares_gain, psnr, ssim
from udccal.restoration.runtime import Restorer
from udccal.simulation.backscatter import backscatter_rate
from udccal.simulation.blur import SpaceVariantBlur
from udccal.simulation.scene import WHITE_E_PER_S, ideal_view, render_photograph
from udccal.simulation.sensor import Sensor
from udccal.simulation.truth import RigTruth
from udccal.simulation.wire import wire_map

DISTANCE_MM, WIDTH_MM = 2000.0, 3200.0
_BEFORE_DB, _WITHIN_DB, _TRIES = 21.5, 0.1, 12
_FILL = 0.85
# Panel pictures that no calibration has shown.
_PICTURE_SEEDS = (9001, 9002, 9003, 9004)


@dataclass(frozen=True)
class Conditions:
    """What a frame is taken and restored under.

    Attributes:
        name: for a table.
        light: of the room, in units of the light that is set.
        known: whether ``restore`` is given the picture that the panel shows.
        lit: whether the panel shows one; else it is black, and ``restore`` knows that.
    """

    name: str
    light: float = 1.0
    known: bool = True
    lit: bool = True


CONDITIONS = (
    Conditions("light set for 21.5 dB before, exact panel picture given"),
    Conditions("room light x 0.3", light=0.3),
    Conditions("room light x 3", light=3.0),
    Conditions("panel picture unknown", known=False),
    Conditions("panel black", lit=False),
)

Rgb = Float32[np.ndarray, "rows columns 3"]


@dataclass(frozen=True)
class Shot:
    """One scene: the noise-free mosaic at room light 1 (e-/s, wire included), the truth, and what the panel showed."""

    name: str
    scene_rate: Float32[np.ndarray, "sensor_rows sensor_columns"]
    ideal: Float32[np.ndarray, "view_rows view_columns 3"]
    picture: int


@dataclass(frozen=True)
class Score:
    """How one scene fared; the pictures are display-encoded."""

    name: str
    before_dB: float
    after_dB: float
    before_ssim: float
    after_ssim: float
    restore_s: float
    before: Rgb
    after: Rgb
    truth: Rgb


class PictureBench:
    """A simulated rig that takes pictures of scenes, at a room light that can be set."""

    def __init__(self, truth: RigTruth, blur: SpaceVariantBlur, restorer: Restorer) -> None:
        self._truth, self._blur, self._restorer = truth, blur, restorer
        camera, panel = truth.description.camera, truth.description.panel
        self._channels = cfa_named(camera.cfa).channel_map(camera.rows, camera.columns)
        self._wire = wire_map(truth)
        self._sensor = Sensor(truth)
        self._region = Region(0, 0, camera.columns, camera.rows)
        self.pictures: tuple[UInt8[np.ndarray, "panel_rows panel_columns 3"], ...] = tuple(
            face_picture(seed, panel.columns, panel.rows) for seed in _PICTURE_SEEDS
        )
        self._panel_rates = [
            (backscatter_rate(truth, picture) * self._wire).astype(np.float32) for picture in self.pictures
        ]
        self._black = np.zeros_like(self.pictures[0])

    def shots(self, scenes: Iterable[Scene]) -> list[Shot]:
        """Every scene at its own display exposure."""
        return [self._shot(index, scene) for index, scene in enumerate(scenes)]

    def _shot(self, index: int, scene: Scene) -> Shot:
        view = self._restorer.view
        centre = (float(np.asarray(view.principal_point_px)[0]), float(np.asarray(view.principal_point_px)[1]))
        photograph = Photograph(scene.radiance, WIDTH_MM, DISTANCE_MM)
        ideal = ideal_view(self._truth, photograph, float(view.focal_px), centre, view.columns, view.rows)
        gain = display_exposure(ideal)
        light = render_photograph(self._truth, photograph, self._blur) * (gain * WHITE_E_PER_S)
        mosaic = np.take_along_axis(light, self._channels[..., None], axis=2)[..., 0] * self._wire
        return Shot(
            scene.name, mosaic.astype(np.float32), (ideal * gain).astype(np.float32), index % len(self.pictures)
        )

    def _panel_rate(self, shot: Shot, lit: bool) -> Float32[np.ndarray, "sensor_rows sensor_columns"]:
        """A black panel sends no light."""
        rate = self._panel_rates[shot.picture]
        return rate if lit else np.zeros_like(rate)

    def exposure_s(self, shot: Shot, room_light: float, lit: bool = True) -> float:
        """Exposure at which display white and the panel's light together fill most of the well."""
        white = room_light * WHITE_E_PER_S * float(self._wire.max())
        panel = float(np.percentile(self._panel_rate(shot, lit), 99))
        return _FILL * self._truth.sensor.full_well_e / (white + panel)

    def frame(
        self, shot: Shot, room_light: float, lit: bool = True
    ) -> UInt16[np.ndarray, "sensor_rows sensor_columns"]:
        """The raw frame."""
        rate = room_light * shot.scene_rate + self._panel_rate(shot, lit)
        seed = np.random.default_rng([self._truth.seed, 0x5CE7E, zlib.crc32(shot.name.encode())])
        exposure_s = self.exposure_s(shot, room_light, lit)
        return self._sensor.expose(rate.astype(np.float64), exposure_s, self._region, seed)

    def before(self, shot: Shot, room_light: float, lit: bool = True) -> Rgb:
        """Everything but the cure, display-encoded."""
        linear = self._restorer.before(self.frame(shot, room_light, lit), self.exposure_s(shot, room_light, lit))
        return _displayed(linear, shot, room_light)

    def matched_room_light(self, shots: list[Shot]) -> float:
        """Room light at which the mean PSNR of "before" is the paper's; bisection on its logarithm."""
        low, high = -6.0, 4.0
        for _ in range(_TRIES):
            middle = (low + high) / 2
            mean = float(np.mean([psnr(self.before(s, 2.0**middle), encode_srgb(s.ideal)) for s in shots]))
            if abs(mean - _BEFORE_DB) < _WITHIN_DB:
                break
            low, high = (middle, high) if mean < _BEFORE_DB else (low, middle)
        return 2.0**middle

    def score(self, shot: Shot, matched_light: float, conditions: Conditions = CONDITIONS[0]) -> Score:
        """Before and after against the truth; both get the least-squares gain per channel."""
        truth, room_light, lit = encode_srgb(shot.ideal), conditions.light * matched_light, conditions.lit
        before = self.before(shot, room_light, lit)
        frame, exposure_s = self.frame(shot, room_light, lit), self.exposure_s(shot, room_light, lit)
        shown = self.pictures[shot.picture] if lit else self._black
        start = time.perf_counter()
        linear = self._restorer.restore(frame, exposure_s, shown if conditions.known else None)
        seconds = time.perf_counter() - start
        after = _displayed(linear, shot, room_light)
        return Score(
            shot.name,
            psnr(before, truth),
            psnr(after, truth),
            ssim(before, truth),
            ssim(after, truth),
            seconds,
            before,
            after,
            truth,
        )


def _displayed(linear: Float[np.ndarray, "rows columns 3"], shot: Shot, room_light: float) -> Rgb:
    """Display-encoded with the least-squares gain per channel.

    The gain is found on what a display can show: a flame a thousand times brighter than white, clipped in the frame,
    would else decide it alone.
    """
    shown = np.clip(linear, 0.0, room_light * WHITE_E_PER_S)
    return encode_srgb(linear * least_squares_gain(shown, np.minimum(shot.ideal, 1.0)))
