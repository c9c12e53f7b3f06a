"""A ChArUco board held in front of the panel, rendered ray by ray."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float, Float32, Float64

from udccal.arrangements import Board, BoardSpec
from udccal.simulation.picture import SUPERSAMPLING, supersample
from udccal.simulation.rays import slope_grid
from udccal.simulation.truth import RigTruth

_BLACK, _SURROUND = 0.04, 0.35
_TEXELS_PER_SQUARE = (24, 400)


def render_board_radiance(
    truth: RigTruth, board: Board, margin: tuple[int, int] = (0, 0)
) -> Float64[np.ndarray, "rows columns 1"]:
    """Render a board in grey surroundings on the sensor's pixels and ``margin`` = (rows, columns) around them.

    The result is a radiance; white paper has the radiance 1.
    """
    camera = truth.description.camera
    texture, texels_per_mm = _texture(truth, board)
    rotation, _ = cv2.Rodrigues(np.asarray(board.rotation_vector))
    x, y = (np.arange(-m, n + m, dtype=float) for m, n in ((margin[1], camera.columns), (margin[0], camera.rows)))
    origin = rotation.T @ (truth.optics.pupil_mm - np.asarray(board.translation_mm))
    # Takes slopes (s_x, s_y, 1) to a ray's depth along the board's normal, and to its texel times that depth.
    depth = rotation[:, 2]
    texels = texels_per_mm * (np.outer(origin[:2], depth) - origin[2] * rotation[:, :2].T) - 0.5 * depth
    projection = np.vstack([texels, depth])

    def seen_along(slopes: Float32[np.ndarray, "rows columns 2"]) -> Float64[np.ndarray, "rows columns 1"]:
        rays = cv2.transform(slopes, projection)
        # Rays that run into the board see its face; all others see the surroundings.
        texel = rays[..., :2] / np.maximum(rays[..., 2:], 1e-9)
        np.clip(texel, -10.0, max(texture.shape) + 10.0, out=texel)
        grey = cv2.remap(
            texture,
            texel[..., 0],
            texel[..., 1],
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=(_SURROUND,),
        )
        return grey[..., None].astype(np.float64)

    return supersample(slope_grid(truth, x, y), seen_along)


def board_corners_mm(spec: BoardSpec) -> Float[np.ndarray, "corners 3"]:
    """Return the inner chessboard corners in board coordinates, in the order of their ChArUco numbers."""
    x, y = np.meshgrid(np.arange(1, spec.columns), np.arange(1, spec.rows))
    return np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3) * spec.square_mm


def opencv_board(spec: BoardSpec) -> cv2.aruco.CharucoBoard:
    """Return the board as OpenCV's object."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, spec.dictionary))
    return cv2.aruco.CharucoBoard((spec.columns, spec.rows), spec.square_mm, spec.marker_mm, dictionary)


def _texture(truth: RigTruth, board: Board) -> tuple[Float32[np.ndarray, "texel_rows texel_columns"], float]:
    """Return the printed board, with texels a little coarser than sensor samples, and its texels per millimetre."""
    spec = board.spec
    distance = max(board.translation_mm[2] - truth.optics.pupil_mm[2], spec.square_mm)
    samples = 0.7 * truth.optics.fx_px * spec.square_mm / distance * SUPERSAMPLING
    per_square = int(np.clip(samples, *_TEXELS_PER_SQUARE))
    image = opencv_board(spec).generateImage((spec.columns * per_square, spec.rows * per_square), marginSize=0)
    return (_BLACK + (1 - _BLACK) * (image / 255.0)).astype(np.float32), per_square / spec.square_mm
