"""A painted rig: a camera whose frames are drawn, not computed, so that whole guided captures take seconds."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from procedures.aiming import nominal_pixels
from udccal.arrangements import Arrangement, Board, Dark, FlatLight, Led, Occasion, PanelPicture
from udccal.benches.bench import CaptureBench
from udccal.cameras.protocol import CameraIdentity, Counts, Features, Frame, Mode, Range, Region, Settings, Trigger
from udccal.displays.protocol import PanelSize
from udccal.rig import RigDescription, load_rig
from udccal.sessions.writer import utc_now

_SPOT_PX = 1.4
_PATTERN = np.array([[0.6, 1.0], [1.0, 0.7]])
# Exposures in s at which a light fills the wells.
_FULL_S = {Led: 125e-6, FlatLight: 12e-3, Board: 12e-3, PanelPicture: 0.1}


def painted_rig(fewer: int = 8, **captures: int) -> RigDescription:
    """The full-size rig with ``fewer`` times fewer pixels across, and few frames."""
    rig = load_rig("lg55-aca2040")
    size = {"columns": rig.camera.columns // fewer, "rows": rig.camera.rows // fewer}
    camera = rig.camera.model_copy(update={**size, "pitch_um": fewer * rig.camera.pitch_um})
    few = {"flats": 6, "noise_levels": 4, "noise_stack": 3, "psf_shifts": 2, "psf_exposures": 2, "board_views": 3}
    few |= {"backscatter_pictures": 2, "backscatter_frames": 2, "psf_region_columns": 32, "psf_region_rows": 48}
    panel = rig.panel.model_copy(update={"columns": 64, "rows": 36})
    changed = rig.captures.model_copy(update=few | captures)
    return rig.model_copy(update={"camera": camera, "captures": changed, "panel": panel})


class PaintedRig:
    """Camera, stage and clock. What stands before it is what was arranged; tests may put something else there.

    Attributes:
        asked: what the guide asked for, in order.
        put: what a test has put there instead; None for what was asked for.
        drift_px: how far an LED moves to the right from frame to frame.
        leak_per_s: light of the room, in full wells per second.
    """

    def __init__(self, rig: RigDescription, offset_px: float = 0.0) -> None:
        self.rig, self.offset_px = rig, offset_px
        self.asked: list[Arrangement] = []
        self.put: Arrangement | None = None
        self.drift_px = self.leak_per_s = 0.0
        self.frames_taken = 0
        self._settings = Settings(1e-3, 0.0, self.sensor)

    identity = CameraIdentity("tests", "painted", "1", "painted")
    bits = 12
    mode = Mode("BayerRG12")
    counts = Counts()

    @property
    def sensor(self) -> Region:
        return Region(0, 0, self.rig.camera.columns, self.rig.camera.rows)

    @property
    def cfa(self) -> str:
        return self.rig.camera.cfa

    @property
    def features(self) -> Features:
        camera = self.rig.camera
        exposures = Range(camera.min_exposure_s, camera.max_exposure_s)
        return Features(
            exposures, Range(0.0, 0.0), Range(1.0, 100.0), ("BayerRG12",), (Trigger.FREE_RUN,), (2, 2, 2, 2)
        )

    def __enter__(self) -> PaintedRig:
        return self

    def __exit__(self, *error: object) -> None:
        pass

    def set_mode(self, mode: Mode) -> Mode:
        return mode

    def configure(self, settings: Settings) -> Settings:
        self._settings = settings
        return settings

    def frames(self, count: int) -> Iterator[Frame]:
        for _ in range(count):
            self.frames_taken += 1
            yield Frame(self._paint(), self._settings, 0.1 * self.frames_taken, self.frames_taken, complete=True)

    def arrange(self, arrangement: Arrangement, occasion: Occasion) -> None:
        self.asked.append(arrangement)

    def _paint(self) -> np.ndarray:
        region, camera = self._settings.region, self.rig.camera
        shown = self.put if self.put is not None else (self.asked[-1] if self.asked else Dark())
        light = self._light(shown)[region.y : region.y + region.rows, region.x : region.x + region.columns]
        full_s = _FULL_S.get(type(shown), 1.0)
        well_DN = camera.full_well_e.value * camera.K_DN_per_e.value
        rng = np.random.default_rng(self.frames_taken)
        signal = np.minimum((light / full_s + self.leak_per_s) * self._settings.exposure_s, 1.0) * well_DN
        noise = rng.standard_normal(signal.shape) * np.sqrt(2.0 + camera.K_DN_per_e.value * signal)
        return np.clip(np.rint(camera.black_DN.value + signal + noise), 0, 4095).astype(np.uint16)

    def _light(self, shown: Arrangement) -> np.ndarray:
        rows, columns = self.rig.camera.rows, self.rig.camera.columns
        pattern = np.tile(_PATTERN, (rows // 2, columns // 2))
        match shown:
            case Led(x_px, y_px):
                x = x_px + self.offset_px + self.drift_px * self.frames_taken
                down, across = np.arange(rows) - y_px - self.offset_px, np.arange(columns) - x
                spot = (np.exp(-(side**2) / (2 * _SPOT_PX**2)) for side in (down, across))
                return np.outer(*spot) * pattern
            case Board():
                return self._board(shown) * pattern
            case FlatLight() | PanelPicture():
                return pattern
        return np.zeros((rows, columns))

    def _board(self, board: Board) -> np.ndarray:
        spec, size = board.spec, (self.rig.camera.columns, self.rig.camera.rows)
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, spec.dictionary))
        printed = cv2.aruco.CharucoBoard((spec.columns, spec.rows), spec.square_mm, spec.marker_mm, dictionary)
        picture = printed.generateImage((40 * spec.columns, 40 * spec.rows)).astype(np.float32) / 255
        width, height = spec.columns * spec.square_mm, spec.rows * spec.square_mm
        corners = np.array([[0, 0, 0], [width, 0, 0], [width, height, 0], [0, height, 0.0]])
        turn = cv2.Rodrigues(np.array(board.rotation_vector))[0]
        seen = nominal_pixels(self.rig, corners @ turn.T + np.array(board.translation_mm)).astype(np.float32)
        edges = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32) * [picture.shape[1], picture.shape[0]]
        warp = cv2.getPerspectiveTransform(edges.astype(np.float32) - 0.5, seen)
        return cv2.warpPerspective(picture, warp, size, flags=cv2.INTER_AREA, borderValue=0.5)


class Panel:
    """A panel that shows whatever it is given."""

    def __init__(self, rig: RigDescription) -> None:
        self.size = PanelSize(rig.panel.columns, rig.panel.rows)

    def __enter__(self) -> Panel:
        return self

    def __exit__(self, *error: object) -> None:
        pass

    def show(self, picture: np.ndarray) -> None:
        pass

    def off(self) -> None:
        pass

    def check(self) -> None:
        pass


def painted_bench(painted: PaintedRig) -> CaptureBench:
    return CaptureBench(painted.rig, painted, Panel(painted.rig), painted, utc_now)
