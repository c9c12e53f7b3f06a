"""Puts a photograph in front of a simulated rig: the camera's frame, and the view without the panel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8, UInt16

from udccal.arrangements import Photograph
from udccal.cameras.protocol import Settings
from udccal.cameras.simulated import SimulatedCamera
from udccal.models.geometry import VirtualView
from udccal.simulation.scene import ideal_view
from udccal.simulation.truth import pixels_to_directions
from udccal.simulation.world import SimulatedWorld

DISTANCE_MM = 2000.0
_PERCENTILE, _FILL = 99.5, 0.8
_MARGIN = 1.06
_TRIAL_S = 1e-3


@dataclass(frozen=True)
class CapturedScene:
    """One frame of a photograph, and the same view without panel, noise and lens in e-/s."""

    mosaic: UInt16[np.ndarray, "rows columns"]
    exposure_s: float
    ideal: Float[np.ndarray, "view_rows view_columns 3"]


def capture_photograph(
    world: SimulatedWorld,
    radiance: Float[np.ndarray, "photo_rows photo_columns 3"],
    view: VirtualView,
    panel_picture: UInt8[np.ndarray, "panel_rows panel_columns 3"] | None,
) -> CapturedScene:
    """Hang a photograph so that it fills the view, show a picture on the panel, and take one well-exposed frame.

    Args:
        world: simulated rig.
        radiance: photograph in linear light; 1 is white paper in a lit room.
        view: virtual view that the photograph fills.
        panel_picture: 8-bit RGB picture on the panel; None for a dark panel.
    """
    depth_mm = DISTANCE_MM - float(world.truth.optics.pupil_mm[2])
    hung, width_px = _hung(world, radiance, view)
    photograph = Photograph(hung, width_px / float(view.focal_px) * depth_mm, DISTANCE_MM, panel_picture)
    with SimulatedCamera(world) as camera:
        world.arrange(photograph)
        exposure_s = _exposure(camera, world)
        camera.configure(Settings(exposure_s, 0.0, camera.sensor))
        (frame,) = camera.frames(1)
    centre = (float(np.asarray(view.principal_point_px)[0]), float(np.asarray(view.principal_point_px)[1]))
    ideal = ideal_view(world.truth, photograph, float(view.focal_px), centre, view.columns, view.rows)
    return CapturedScene(frame.data, frame.settings.exposure_s, ideal)


def _hung(
    world: SimulatedWorld, radiance: Float[np.ndarray, "rows columns 3"], view: VirtualView
) -> tuple[Float[np.ndarray, "hung_rows hung_columns 3"], float]:
    """Return a photograph that just covers the view, and its width in px of the view.

    A photograph hangs with its middle on the ray of the sensor's middle; the view's middle lies elsewhere. Mirrored
    margins on the far sides, out of sight, bring the two together.
    """
    rows, columns = radiance.shape[:2]
    scale = _MARGIN * max(view.columns / columns, view.rows / rows)
    camera = world.truth.description.camera
    ray = pixels_to_directions(world.truth.optics, np.array([(camera.columns - 1) / 2, (camera.rows - 1) / 2]))
    middle = np.asarray(view.principal_point_px) + float(view.focal_px) * ray[:2] / ray[2]
    off = np.array([(view.columns - 1) / 2, (view.rows - 1) / 2]) - middle
    more_x, more_y = (round(2 * float(v) / scale) for v in off)
    margins = [(max(more_y, 0), max(-more_y, 0)), (max(more_x, 0), max(-more_x, 0)), (0, 0)]
    return np.pad(radiance, margins, mode="symmetric"), scale * (columns + abs(more_x))


def _exposure(camera: SimulatedCamera, world: SimulatedWorld) -> float:
    """Return the exposure in s that puts the bright parts at 80 % of the range, from one trial frame."""
    rig = world.truth.description
    exposure_s = _TRIAL_S
    for _ in range(3):
        accepted = camera.configure(Settings(exposure_s, 0.0, camera.sensor))
        (frame,) = camera.frames(1)
        level = float(np.percentile(frame.data, _PERCENTILE)) - rig.camera.black_DN.value
        wanted = _FILL * (rig.saturation_DN - rig.camera.black_DN.value)
        exposure_s = accepted.exposure_s * min(wanted / max(level, 1.0), 8.0)
        exposure_s = min(max(exposure_s, rig.camera.min_exposure_s), rig.camera.max_exposure_s)
    return exposure_s
