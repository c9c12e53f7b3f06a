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

from tests.benchmarks.scenes import DISTANCE_MM, WIDTH_MM, Scene
from udccal.arrangements import Photograph
from udccal.cameras.protocol import Region
from udccal.cfa import cfa_named
from udccal.displays.pictures import face_picture
from udccal.restoration.metrics import display_exposure, encode_srgb, least_squares_gain, psnr, ssim
from udccal.restoration.runtime import Restorer
from udccal.simulation.backscatter import backscatterer
from udccal.simulation.blur import SpaceVariantBlur
from udccal.simulation.scene import WHITE_E_PER_S, ideal_view, render_photograph
from udccal.simulation.sensor import Sensor
from udccal.simulation.truth import RigTruth
from udccal.simulation.wire import wire_map

__all__ = ["CONDITIONS", "DISTANCE_MM", "WIDTH_MM", "Conditions", "PictureBench", "Rgb", "Score", "Shot", "displayed"]

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
        grey: 8-bit value of the even grey that the panel shows; None where it shows the scene's picture of faces.
    """

    name: str
    light: float = 1.0
    known: bool = True
    grey: int | None = None


CONDITIONS = (
    Conditions("light set for 21.5 dB before, exact panel picture given"),
    Conditions("room light x 0.3", light=0.3),
    Conditions("room light x 3", light=3.0),
    Conditions("panel picture unknown", known=False),
    Conditions("panel black", grey=0),
)

Rgb = Float32[np.ndarray, "rows columns 3"]


@dataclass(frozen=True)
class Shot:
    """One scene through the rig.

    Attributes:
        name: of the scene.
        photograph: the scene.
        gain: display exposure: display white over the scene's unit of radiance.
        scene_rate: the noise-free mosaic at room light 1 in e-/s, wire included.
        ideal: the truth; 1 is display white.
        picture: number of the picture of faces that the panel shows.
    """

    name: str
    photograph: Photograph
    gain: float
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
        self.truth, self.restorer, self._blur = truth, restorer, blur
        camera, panel = truth.description.camera, truth.description.panel
        self._channels = cfa_named(camera.cfa).channel_map(camera.rows, camera.columns)
        self._wire = wire_map(truth)
        self._sensor = Sensor(truth)
        self._region = Region(0, 0, camera.columns, camera.rows)
        self._even: dict[int, UInt8[np.ndarray, "panel_rows panel_columns 3"]] = {}
        self.pictures: tuple[UInt8[np.ndarray, "panel_rows panel_columns 3"], ...] = tuple(
            face_picture(seed, panel.columns, panel.rows) for seed in _PICTURE_SEEDS
        )
        panel_of = backscatterer(truth)
        self._panel_rates = [(panel_of.rate(picture) * self._wire).astype(np.float32) for picture in self.pictures]
        self._white_rate = (panel_of.rate(np.full_like(self.pictures[0], 255)) * self._wire).astype(np.float32)

    def shots(self, scenes: Iterable[Scene]) -> list[Shot]:
        """Every scene at its own display exposure."""
        return [self._shot(index, scene) for index, scene in enumerate(scenes)]

    def _shot(self, index: int, scene: Scene) -> Shot:
        view = self.restorer.view
        centre = (float(np.asarray(view.principal_point_px)[0]), float(np.asarray(view.principal_point_px)[1]))
        photograph = Photograph(scene.radiance, scene.width_mm, DISTANCE_MM)
        ideal = ideal_view(self.truth, photograph, float(view.focal_px), centre, view.columns, view.rows)
        gain = display_exposure(ideal)
        light = render_photograph(self.truth, photograph, self._blur) * (gain * WHITE_E_PER_S)
        return Shot(
            name=scene.name,
            photograph=photograph,
            gain=gain,
            scene_rate=(self.mosaic(light) * self._wire).astype(np.float32),
            ideal=(ideal * gain).astype(np.float32),
            picture=index % len(self.pictures),
        )

    def mosaic(
        self, light: Float[np.ndarray, "sensor_rows sensor_columns 3"]
    ) -> Float[np.ndarray, "sensor_rows sensor_columns"]:
        """What the colour filters let through."""
        return np.take_along_axis(light, self._channels[..., None], axis=2)[..., 0]

    def shown(self, shot: Shot, grey: int | None) -> UInt8[np.ndarray, "panel_rows panel_columns 3"]:
        """What the panel shows: the shot's faces, or an even grey."""
        if grey is None:
            return self.pictures[shot.picture]
        return self._even.setdefault(grey, np.full_like(self.pictures[0], grey))

    def _panel_rate(self, shot: Shot, grey: int | None) -> Float32[np.ndarray, "sensor_rows sensor_columns"]:
        """The panel's light in e-/s, wire included; its transfer curve is a power."""
        if grey is None:
            return self._panel_rates[shot.picture]
        return self._white_rate * np.float32((grey / 255) ** self.truth.panel.gamma)

    def exposure_s(self, shot: Shot, room_light: float, grey: int | None = None) -> float:
        """Exposure at which display white and the panel's light together fill most of the well."""
        white = room_light * WHITE_E_PER_S * float(self._wire.max())
        panel = float(np.percentile(self._panel_rate(shot, grey), 99))
        return self.filling_s(white + panel)

    def filling_s(self, rate_e_per_s: float) -> float:
        """Exposure at which a rate fills most of the well."""
        return _FILL * self.truth.sensor.full_well_e / rate_e_per_s

    def frame(
        self, shot: Shot, room_light: float, grey: int | None = None
    ) -> UInt16[np.ndarray, "sensor_rows sensor_columns"]:
        """The raw frame."""
        rate = room_light * shot.scene_rate + self._panel_rate(shot, grey)
        return self.exposed(rate, self.exposure_s(shot, room_light, grey), shot.name)

    def exposed(
        self, rate_e_per_s: Float32[np.ndarray, "sensor_rows sensor_columns"], exposure_s: float, name: str
    ) -> UInt16[np.ndarray, "sensor_rows sensor_columns"]:
        """The raw frame of a light; its noise is that of a scene's name."""
        seed = np.random.default_rng([self.truth.seed, 0x5CE7E, zlib.crc32(name.encode())])
        return self._sensor.expose(rate_e_per_s.astype(np.float64), exposure_s, self._region, seed)

    def before(self, shot: Shot, room_light: float, grey: int | None = None) -> Rgb:
        """Everything but the cure, display-encoded."""
        linear = self.restorer.before(self.frame(shot, room_light, grey), self.exposure_s(shot, room_light, grey))
        return displayed(linear, shot, room_light)

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
        truth, room_light, grey = encode_srgb(shot.ideal), conditions.light * matched_light, conditions.grey
        before = self.before(shot, room_light, grey)
        frame, exposure_s = self.frame(shot, room_light, grey), self.exposure_s(shot, room_light, grey)
        shown = self.shown(shot, grey)
        start = time.perf_counter()
        linear = self.restorer.restore(frame, exposure_s, shown if conditions.known else None)
        seconds = time.perf_counter() - start
        after = displayed(linear, shot, room_light)
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


def displayed(linear: Float[np.ndarray, "rows columns 3"], shot: Shot, room_light: float) -> Rgb:
    """Display-encoded with the least-squares gain per channel.

    The gain is found on what a display can show: a flame a thousand times brighter than white, clipped in the frame,
    would else decide it alone.
    """
    shown = np.clip(linear, 0.0, room_light * WHITE_E_PER_S)
    return encode_srgb(linear * least_squares_gain(shown, np.minimum(shot.ideal, 1.0)))
