"""Frames for a live run: of a simulated rig, of files, or of a real camera."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal, final

import numpy as np
from jaxtyping import UInt8

from udccal.arguments import check_number
from udccal.benches.bench import simulated_rig
from udccal.benches.photograph import capture_photograph
from udccal.cameras.checks import check_settings
from udccal.cameras.choice import check_camera, mode_for
from udccal.cameras.files import FileCamera
from udccal.cameras.picture_files.sidecar import list_folder
from udccal.cameras.protocol import Camera, CameraIdentity, Frame, Range, Region, Settings
from udccal.cameras.simulated import SimulatedCamera
from udccal.cli.jobs.benches import pylon_camera, u3v_camera
from udccal.cli.jobs.demonstration import portrait
from udccal.errors import CameraError
from udccal.live.pacing import looped, paced, streamed
from udccal.models.geometry import VirtualView
from udccal.restoration.checks import check_exposure
from udccal.rig import RigDescription
from udccal.sessions.schema import StoredCamera
from udccal.simulation.world import SimulatedWorld

# Frames of the simulated loop. They differ in their noise.
_LOOP: Final = 8
_DEFAULT_EXPOSURE_S: Final = 8e-3

PanelPicture = UInt8[np.ndarray, "panel_rows panel_columns 3"]
# Delivers frames of these rows at least, and says of which; a simulated camera sees a scene that fills the view, and
# what the panel shows.
Frames = Callable[[VirtualView, PanelPicture | None, slice], tuple[Iterator[Frame], slice]]
# Rows above and below those that the view needs: a profile that replaces this one may see a little further.
_SPARE_ROWS: Final = 16


@final
@dataclass(frozen=True)
class LiveCamera:
    """Which camera, and how it is set.

    Attributes:
        kind: the backend.
        serial: serial number of a real camera; None for the only one.
        files: folder of raw frames; None for other cameras.
        exposure_s: exposure; None for 8 ms, for the files' own, or for what suits the simulated scene.
        rate_hz: frames per second.
        seed: specimen of the simulated rig.
    """

    kind: Literal["sim", "u3v", "pylon", "files"]
    serial: str | None
    files: Path | None
    exposure_s: float | None
    rate_hz: float
    seed: int

    def __post_init__(self) -> None:
        if (self.kind == "files") != (self.files is not None):
            raise CameraError("Expected --files with --camera files, and only there, found one of them. Give both.")
        check_number(self.rate_hz, "a rate of frames in Hz", (1e-3, 1e5), "Give that of the camera.", CameraError)
        if self.exposure_s is not None:
            check_exposure(self.exposure_s, CameraError)

    @contextlib.contextmanager
    def open(self, rig: RigDescription, made_with: StoredCamera | None = None) -> Iterator[Frames]:
        """Open the camera and check that it is the rig's; yield what then delivers its frames.

        Args:
            rig: the rig description.
            made_with: camera of the profile's captures; None where nobody knows.

        Raises:
            CameraError: when it cannot be opened, does not fit the rig, or does not have the exposure.
        """
        if self.kind == "sim":
            world = simulated_rig(rig, self.seed)
            if self.exposure_s is not None:
                camera = SimulatedCamera(world)
                check_settings(Settings(self.exposure_s, 0.0, camera.sensor), camera.features, camera.sensor)

            def simulated(view: VirtualView, shown: PanelPicture | None, rows: slice) -> tuple[Iterator[Frame], slice]:
                frames = self._rendered(world, view, shown, rows)
                return looped(frames, self.rate_hz), _rows_of(frames[0].settings.region)

            yield simulated
        elif self.files is not None:
            with FileCamera(self.files, rig.camera.cfa, rig.camera.bits, self.exposure_s) as files:
                check_camera(files, rig)
                count = len(list_folder(self.files))
                whole = slice(0, rig.camera.rows)
                yield lambda view, shown, rows: (paced(files.frames(count), self.rate_hz), whole)
        else:
            with u3v_camera(self.serial) if self.kind == "u3v" else pylon_camera(self.serial) as real:
                _check_specimen(real.identity, made_with)
                self._set(real, rig)
                check_camera(real, rig)
                yield lambda view, shown, rows: self._reading(real, rows)

    def _rendered(
        self, world: SimulatedWorld, view: VirtualView, panel_picture: PanelPicture | None, rows: slice
    ) -> tuple[Frame, ...]:
        """Return a few frames of a photograph before the simulated rig, so that simulation takes no time later."""
        scene = capture_photograph(world, portrait(), view, panel_picture)
        with SimulatedCamera(world) as camera:
            region = region_of(rows, camera.sensor, camera.features.region_steps)
            camera.configure(Settings(self.exposure_s or scene.exposure_s, 0.0, region))
            return tuple(camera.frames(_LOOP))

    def _reading(self, camera: Camera, rows: slice) -> tuple[Iterator[Frame], slice]:
        """Have the camera read these rows."""
        region = region_of(rows, camera.sensor, camera.features.region_steps)
        camera.configure(self._settings(camera, region))
        return streamed(camera), _rows_of(region)

    def _settings(self, camera: Camera, region: Region) -> Settings:
        exposure_s = self.exposure_s or _within(_DEFAULT_EXPOSURE_S, camera.features.exposure_s)
        return Settings(exposure_s, _within(0.0, camera.features.gain_dB), region)

    def _set(self, camera: Camera, rig: RigDescription) -> None:
        mode = mode_for(camera.features, camera.sensor, rig.camera.cfa, rig.camera.bits)
        rate_hz = _within(min(self.rate_hz, mode.frame_rate_hz or self.rate_hz), camera.features.frame_rate_hz)
        camera.set_mode(replace(mode, frame_rate_hz=rate_hz))
        camera.configure(self._settings(camera, camera.sensor))


def region_of(rows: slice, sensor: Region, steps: tuple[int, int, int, int]) -> Region:
    """Return the region of whole rows that has these and some to spare, in the camera's ``region_steps``."""
    _, step_y, _, step_rows = steps
    first = max(rows.start - _SPARE_ROWS, 0) // step_y * step_y
    count = -(-(min(rows.stop + _SPARE_ROWS, sensor.rows) - first) // step_rows) * step_rows
    return Region(0, first, sensor.columns, count) if first + count <= sensor.rows else sensor


def _rows_of(region: Region) -> slice:
    return slice(region.y, region.y + region.rows)


def _check_specimen(found: CameraIdentity, made_with: StoredCamera | None) -> None:
    """Refuse another camera than a profile's; only one backend's serial numbers can be compared."""
    if made_with is not None and made_with.backend == found.backend and made_with.serial != found.serial:
        raise CameraError(
            f"Expected the camera that the profile was made with, {made_with.model}, serial {made_with.serial}, found "
            f"{found.model}, serial {found.serial}. Connect the right one, or calibrate the rig with this one."
        )


def _within(value: float, bounds: Range) -> float:
    return min(max(value, bounds.low), bounds.high)
