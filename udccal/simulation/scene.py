"""Scenes in front of the panel, as light on the sensor before wire, backscatter, colour filters and noise.

Rates are electrons per second of each camera colour; a radiance of 1 gives ``WHITE_E_PER_S``. Radiance channels feed
camera colours one to one. The fall-off of light towards the corners belongs to the wire term.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from udccal.arrangements import Board, Photograph
from udccal.simulation.blur import SpaceVariantBlur
from udccal.simulation.board import render_board_radiance
from udccal.simulation.panorama import panorama_view
from udccal.simulation.picture import SUPERSAMPLING, PlanePicture, place_picture, supersample
from udccal.simulation.rays import slope_grid
from udccal.simulation.truth import RigTruth

__all__ = ["WHITE_E_PER_S", "ideal_view", "panorama_view", "render_board", "render_photograph"]

# A white scene fills an 11 000 e- well in about 8 ms, one frame of a 120 Hz camera.
WHITE_E_PER_S = 1.4e6


def render_photograph(
    truth: RigTruth, photograph: Photograph, blur: SpaceVariantBlur | None = None
) -> Float[np.ndarray, "rows columns 3"]:
    """Render a photograph as the lens images it through the panel, in e-/s on every sensor pixel.

    Its centre lies on the ray of the sensor's middle; x runs right and y down along the panel's axes.
    """
    camera = truth.description.camera
    margin_rows, margin_columns = blur.margin if blur else (0, 0)
    x = np.arange(-margin_columns, camera.columns + margin_columns, dtype=float)
    y = np.arange(-margin_rows, camera.rows + margin_rows, dtype=float)
    picture = _placed(truth, photograph, truth.optics.fx_px)
    canvas = supersample(slope_grid(truth, x, y), lambda slopes: picture.at(_points_mm(truth, photograph, slopes)))
    return WHITE_E_PER_S * (blur.apply(canvas) if blur else canvas)


def ideal_view(
    truth: RigTruth,
    photograph: Photograph,
    focal_px: float,
    centre: tuple[float, float],
    columns: int,
    rows: int,
) -> Float[np.ndarray, "rows columns 3"]:
    """Render the same photograph in e-/s for a pinhole at the pupil without the panel.

    Args:
        truth: the simulated rig.
        photograph: the scene.
        focal_px: focal length of the view, whose image plane is parallel to the panel.
        centre: (x, y) of the panel's normal in the view, in px.
        columns: columns of the view. rows: rows of the view.
    """
    x, y = (np.arange(columns) - centre[0]) / focal_px, (np.arange(rows) - centre[1]) / focal_px
    picture = _placed(truth, photograph, focal_px)
    slopes = np.stack(np.meshgrid(x, y), axis=-1)
    return WHITE_E_PER_S * supersample(slopes, lambda near: picture.at(_points_mm(truth, photograph, near)))


def render_board(
    truth: RigTruth, board: Board, blur: SpaceVariantBlur | None = None
) -> Float[np.ndarray, "rows columns 3"]:
    """Render a board in even grey surroundings in e-/s on every sensor pixel; white paper has the radiance 1."""
    radiance = render_board_radiance(truth, board, blur.margin if blur else (0, 0))
    return WHITE_E_PER_S * (blur.apply(radiance) if blur else np.repeat(radiance, 3, axis=-1))


def _points_mm(truth: RigTruth, photograph: Photograph, slopes: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
    """Intersect rays from the pupil with the photograph's plane, in panel coordinates."""
    pupil = truth.optics.pupil_mm
    return pupil[:2] + (photograph.distance_mm - pupil[2]) * slopes


def _placed(truth: RigTruth, photograph: Photograph, focal_px: float) -> PlanePicture:
    """Place the photograph on its plane, resized for a camera of focal length ``focal_px``."""
    camera = truth.description.camera
    middle = slope_grid(
        truth, (camera.columns - 1) / 2 + np.linspace(-8.0, 8.0, 5), (camera.rows - 1) / 2 + np.linspace(-8.0, 8.0, 5)
    )[2, 2]
    sample_mm = (photograph.distance_mm - truth.optics.pupil_mm[2]) / focal_px / SUPERSAMPLING
    return place_picture(
        photograph.radiance, photograph.width_mm, _points_mm(truth, photograph, middle), float(sample_mm)
    )
