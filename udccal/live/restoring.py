"""The restorer of a live run, which another of the same camera may replace between two frames.

The camera may read fewer rows than the sensor has.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, final

import jax
import numpy as np
from jaxtyping import UInt8, UInt16

from udccal.cameras.protocol import Frame
from udccal.errors import LiveError, PanelPictureError
from udccal.live.exposure import AutoExposure
from udccal.live.own_pictures import OwnPictures, PanelPicture
from udccal.restoration.device.restorer import DeviceRestorer
from udccal.restoration.linear import variance_floor_e2
from udccal.restoration.runtime import Restorer
from udccal.restoration.tone import Tone
from udccal.rig import RigDescription

# Light that the first exposure shows as bright, in sigma of a dark sample: a dark beginning is not amplified to white.
_LEAST_SIGMAS: Final = 10.0


def unnoted() -> None:
    """Take no note of a frame."""


@final
class Restoring:
    """Restores frames to 8-bit pictures of one size with the present restorer.

    Args:
        restorer: the first restorer.
        panel: what the panel shows: always the same 8-bit RGB picture, or the run's own; None when not known.
        device: of JAX, on which frames are restored; None for the processor.
        read: rows of the sensor that the camera reads; None for all.

    Raises:
        LiveError: when it lacks rows that the view needs.
        RestorationError: when the tier does not run on a device.
    """

    def __init__(
        self,
        restorer: Restorer,
        panel: PanelPicture | OwnPictures | None = None,
        device: jax.Device | None = None,
        read: slice | None = None,
    ) -> None:
        self._panel, self._device = panel, device
        self._exposure: AutoExposure | None = None
        self._whole: UInt16[np.ndarray, "sensor_rows sensor_columns"] | None = None
        self._read = slice(0, restorer.rig.camera.rows) if read is None else read
        self._check_rows(restorer)
        self._shows = self._warm(restorer)

    @property
    def _restorer(self) -> Restorer:
        return _restorer_of(self._shows)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the pictures."""
        return self._restorer.view.rows, self._restorer.view.columns

    def replace(self, restorer: Restorer) -> None:
        """Use ``restorer`` from the next frame on.

        Raises:
            LiveError: when its camera, panel or view has another size, or the camera another pattern or other bits. The
                frames, the panel's picture and the sink of a run stay those of its beginning.
        """
        before, after = _sizes(self._restorer.rig), _sizes(restorer.rig)
        if before != after:
            raise LiveError(
                f"Expected a changed profile of {before}, with which this run began, found one of {after}. "
                "Start another run for it."
            )
        self._check_rows(restorer)
        self._shows = self._warm(restorer)

    def restore(
        self, frame: Frame, captured_ns: int, without_panel_picture: Callable[[], None] = unnoted
    ) -> UInt8[np.ndarray, "rows columns 3"]:
        """Return a frame, which arrived at ``captured_ns`` of the monotonic clock, as display-encoded RGB.

        One that is darker than the panel's picture was taken of something else: the panel went dark for a moment, or
        showed the picture later. It is restored as if nobody knew the picture.

        Args:
            frame: of the profile's camera.
            captured_ns: when it arrived.
            without_panel_picture: called for such a frame.

        Raises:
            LiveError: when it lacks rows that the view needs.
            RestorationError: when the frame is not of the profile's camera.
        """
        shows, exposure_s, shown = self._shows, frame.settings.exposure_s, self._shown(captured_ns)
        mosaic = self._of_sensor(frame)
        try:
            return self._picture(shows, mosaic, exposure_s, shown)
        except PanelPictureError:
            without_panel_picture()
            return self._picture(shows, mosaic, exposure_s, None)

    def _picture(
        self,
        shows: Restorer | DeviceRestorer,
        mosaic: UInt16[np.ndarray, "sensor_rows sensor_columns"],
        exposure_s: float,
        shown: PanelPicture | None,
    ) -> UInt8[np.ndarray, "rows columns 3"]:
        restorer = _restorer_of(shows)
        clips = restorer.clipping_light(exposure_s)
        if self._exposure is None:
            noise_e = variance_floor_e2(restorer.noise, exposure_s) ** 0.5
            linear = restorer.restore(mosaic, exposure_s, shown)
            self._exposure = AutoExposure(linear, _LEAST_SIGMAS * noise_e / exposure_s, clips)
        picture = shows.display(mosaic, exposure_s, self._exposure.tone, shown)
        if not self._exposure.follow(picture, clips):
            self._exposure = None
        return picture

    def _shown(self, captured_ns: int) -> PanelPicture | None:
        return self._panel.at(captured_ns) if isinstance(self._panel, OwnPictures) else self._panel

    def _of_sensor(self, frame: Frame) -> UInt16[np.ndarray, "rows columns"]:
        """Return a frame of the whole sensor: rows that were not read are as those read beside them at first."""
        camera, region = self._restorer.rig.camera, frame.settings.region
        rows = slice(region.y, region.y + region.rows)
        if frame.data.shape != (region.rows, camera.columns) or region.rows == camera.rows or rows.stop > camera.rows:
            return frame.data  # whole, or of another camera, which is refused
        if self._whole is None or rows != self._read:
            self._read = rows
            self._check_rows(self._restorer)
            # Mirrored, the colour pattern goes on.
            self._whole = np.pad(frame.data, ((rows.start, camera.rows - rows.stop), (0, 0)), mode="reflect")
        self._whole[rows] = frame.data
        return self._whole

    def _check_rows(self, restorer: Restorer) -> None:
        wanted, read = restorer.seen_rows, self._read
        if wanted.start < read.start or wanted.stop > read.stop:
            raise LiveError(
                f"Expected rows {wanted.start} to {wanted.stop} of the sensor, which the view needs, found that the "
                f"camera reads rows {read.start} to {read.stop}. Start another run."
            )

    def _warm(self, restorer: Restorer) -> Restorer | DeviceRestorer:
        """Restore a grey frame: the first takes longer than others, and the camera's next ones would be dropped."""
        camera = restorer.rig.camera
        grey = np.full((camera.rows, camera.columns), 1 << (camera.bits - 1), np.uint16)
        panel = restorer.rig.panel
        shown = None if self._panel is None else np.zeros((panel.rows, panel.columns, 3), np.uint8)
        restorer.restore(grey, camera.min_exposure_s, shown)
        shows = restorer if self._device is None else DeviceRestorer.of(restorer, self._device)
        shows.display(grey, camera.min_exposure_s, Tone(1.0), shown)
        return shows


def _restorer_of(shows: Restorer | DeviceRestorer) -> Restorer:
    return shows.restorer if isinstance(shows, DeviceRestorer) else shows


def _sizes(rig: RigDescription) -> str:
    camera, view, panel = rig.camera, rig.view, rig.panel
    samples = f"{camera.columns} x {camera.rows} {camera.cfa} samples of {camera.bits} bits"
    return f"{samples}, a panel of {panel.columns} x {panel.rows} and a view of {view.columns} x {view.rows}"
