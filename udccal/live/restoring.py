"""The restorer of a live run, which another of the same camera may replace between two frames."""

from __future__ import annotations

from typing import final

import numpy as np
from jaxtyping import UInt8

from udccal.cameras.protocol import Frame
from udccal.errors import LiveError
from udccal.live.exposure import AutoExposure
from udccal.restoration.runtime import Restorer
from udccal.restoration.tone import Tone
from udccal.rig import RigDescription


@final
class Restoring:
    """Restores frames to 8-bit pictures of one size with the present restorer.

    Args:
        restorer: the first restorer.
        panel_picture: what the panel shows all the time, 8-bit RGB; None when not known.
    """

    def __init__(
        self, restorer: Restorer, panel_picture: UInt8[np.ndarray, "panel_rows panel_columns 3"] | None = None
    ) -> None:
        self._panel_picture = panel_picture
        self._exposure: AutoExposure | None = None
        self._restorer = self._warm(restorer)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the pictures."""
        return self._restorer.view.rows, self._restorer.view.columns

    def replace(self, restorer: Restorer) -> None:
        """Use ``restorer`` from the next frame on.

        Raises:
            LiveError: when its camera or its view has another size or pattern, as the sink is open for these.
        """
        before, after = _sizes(self._restorer.rig), _sizes(restorer.rig)
        if before != after:
            raise LiveError(
                f"Expected a changed profile of {before}, with which this run began, found one of {after}. "
                "Start another run for it."
            )
        self._restorer = self._warm(restorer)

    def restore(self, frame: Frame) -> UInt8[np.ndarray, "rows columns 3"]:
        """Return a frame as display-encoded RGB.

        Raises:
            RestorationError: when the frame is not of the profile's camera.
        """
        restorer, exposure_s, shown = self._restorer, frame.settings.exposure_s, self._panel_picture
        if self._exposure is None:
            self._exposure = AutoExposure(restorer.restore(frame.data, exposure_s, shown))
        picture = restorer.display(frame.data, exposure_s, self._exposure.tone, shown)
        self._exposure.follow(picture)
        return picture

    def _warm(self, restorer: Restorer) -> Restorer:
        """Restore a grey frame: the first takes longer than others, and the camera's next ones would be dropped."""
        camera = restorer.rig.camera
        grey = np.full((camera.rows, camera.columns), 1 << (camera.bits - 1), np.uint16)
        restorer.restore(grey, camera.min_exposure_s, self._panel_picture)
        restorer.display(grey, camera.min_exposure_s, Tone(1.0), self._panel_picture)
        return restorer


def _sizes(rig: RigDescription) -> str:
    camera, view = rig.camera, rig.view
    return f"{camera.columns} x {camera.rows} {camera.cfa} samples and a view of {view.columns} x {view.rows}"
