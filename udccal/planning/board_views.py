"""What one planned view of a board tells: the corners that it shows, their scatter, and the slopes of their places."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.spatial.transform import Rotation
from scipy.special import erf

from udccal.arrangements import Board, BoardSpec
from udccal.fitting.engine.gaussian import marginal_information
from udccal.fitting.geometry.corners import MIN_CORNERS, board_points_mm, charuco_board
from udccal.models.geometry import Geometry, project, rotation_matrix
from udccal.planning.state import WHITE, EvenField, RigState, sample_variance_e
from udccal.planning.steps import PlannedStep

LENS = 9
# What a saddle leaves out of a corner, by axis, where no profile has measured it. Edges of the board on the jig run
# along the sensor's rows: samples meet them at few phases, and corners scatter more than on boards that lean.
_ON_JIG_PX, _BY_HAND_PX = 0.0085, 0.006
# White paper reflects so much more than black ink that half the difference is this part of white.
_HALF_CONTRAST = 0.47
# Edges after lens, pixel and the filter that makes a grey picture of a mosaic (one sigma).
_EDGE_PX = 1.0
# A saddle's window in squares (markers stand beyond it), and its least and largest radius in px.
_WINDOW_SQUARES, _WINDOW_PX = 0.16, (4.0, 25.0)


@final
@dataclass(frozen=True)
class PlannedView:
    """Information on the lens (9) and, of a board parallel to the panel, on the panel's rotation (3); corners seen."""

    information: Float[np.ndarray, "12 12"]
    corners: int
    parallel: bool


def lens_vector(geometry: Geometry) -> Float[np.ndarray, "9"]:
    """(fx, fy, cx, cy, k1, k2, p1, p2, k3)."""
    parts = (geometry.focal, geometry.centre, geometry.distortion)
    return np.concatenate([np.asarray(part, dtype=np.float64) for part in parts])


def planned_view(state: RigState, field: EvenField, step: PlannedStep, board: Board) -> PlannedView | None:
    """None where the board shows too few corners to hold its pose."""
    corners = board_points_mm(board.spec)
    rotation, origin = _pose(board, state.geometry)
    lens = lens_vector(state.geometry)
    pixels, slopes = (np.asarray(part) for part in _seen(lens, rotation, origin, corners))
    depth = float((rotation @ corners.mean(axis=0) + origin)[2])
    radius = float(np.clip(_WINDOW_SQUARES * board.spec.square_mm / depth * lens[0], *_WINDOW_PX))
    markers = np.asarray(charuco_board(board.spec).getObjPoints(), dtype=np.float64).reshape(-1, 3)
    seen_markers = _inside(state, np.asarray(_jitted_places(lens, rotation, origin, markers)), 1.0)
    marked = np.asarray(np.all(seen_markers.reshape(-1, 4), axis=1), dtype=bool)
    inside = _inside(state, pixels, np.ceil(radius) + 1)
    good = np.asarray(inside & _named(corners, markers, marked, board.spec))
    if depth <= 0 or good.sum() < MIN_CORNERS:
        return None
    noise = noise_scatter_px(state, field, step, pixels[good], radius)
    scatter = np.hypot(noise, _scatter_px(state, board))
    whole = slopes[good] / scatter[:, None, None]
    information = np.einsum("cai,caj->ij", whole, whole)
    kept = LENS + (3 if board.parallel_to_panel else 0)
    reduced = np.zeros((LENS + 3, LENS + 3))
    reduced[:kept, :kept] = marginal_information(information, kept)
    return PlannedView(reduced, int(good.sum()), board.parallel_to_panel)


def _scatter_px(state: RigState, board: Board) -> float:
    """Beside noise; the few views that lean so far that squares are scarcely resolved count for little in any fit."""
    if board.parallel_to_panel:
        return _ON_JIG_PX if state.unexplained.on_jig_px is None else state.unexplained.on_jig_px
    return _BY_HAND_PX if state.unexplained.by_hand_px is None else state.unexplained.by_hand_px


def noise_scatter_px(
    state: RigState, field: EvenField, step: PlannedStep, pixels: Float[np.ndarray, "n 2"], radius: float
) -> Float[np.ndarray, " n"]:
    """Scatter of saddles by temporal noise of the board's frames; boards are divided by far more frames of the flat."""
    white = (step.level or 0.0) * state.full_well_e * field.at(pixels)
    signal = white[:, None] * np.array(WHITE)[[0, 1, 1, 2]] / max(WHITE)
    temporal = sample_variance_e(state, 0.5 * signal, step.exposures_s[0]) / len(step.exposures_s)
    relative = temporal / signal**2
    return np.asarray(np.sqrt(relative.mean(axis=1)) / _HALF_CONTRAST * saddle_scatter(radius, _EDGE_PX))


def saddle_scatter(radius_px: float, edge_px: float) -> float:
    """Scatter by axis in px of a weighted fit of erf(x) erf(y) with a free slope, at unit noise over contrast."""
    half = int(np.ceil(radius_px))
    y, x = np.mgrid[-half : half + 1, -half : half + 1].astype(np.float64)
    weight = np.clip(1 - (x**2 + y**2) / radius_px**2, 0.0, None).ravel()
    across = np.sqrt(2 / np.pi) / edge_px * np.exp(-0.5 * (x / edge_px) ** 2) * erf(y / (edge_px * np.sqrt(2)))
    design = np.stack([across.ravel(), y.ravel()], axis=1)
    # Windows weigh samples unlike their noise: the covariance is a sandwich.
    inner = np.linalg.inv(design.T @ (design * weight[:, None]))
    cov = inner @ (design.T @ (design * weight[:, None] ** 2)) @ inner
    return float(np.sqrt(cov[0, 0]))


def _pose(board: Board, geometry: Geometry) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    """Board to camera coordinates."""
    to_camera = Rotation.from_rotvec(np.asarray(geometry.rotation)).as_matrix().T
    to_panel = Rotation.from_rotvec(np.array(board.rotation_vector)).as_matrix()
    return to_camera @ to_panel, to_camera @ (np.array(board.translation_mm) - np.asarray(geometry.pupil))


@jax.jit
def _seen(
    lens: Float[Array, "9"], rotation: Float[Array, "3 3"], origin: Float[Array, "3"], points: Float[Array, "n 3"]
) -> tuple[Float[Array, "n 2"], Float[Array, "n 2 15"]]:
    """Places of points of a board, and their slopes by lens, and by turn and place of the board before the camera."""

    def at(x: Float[Array, "15"]) -> Float[Array, "n 2"]:
        return _places(x[:LENS], rotation_matrix(x[LENS : LENS + 3]) @ rotation, origin + x[LENS + 3 :], points)

    start = jnp.concatenate([lens, jnp.zeros(6)])
    return at(start), jax.jacfwd(at)(start)


def _places(
    lens: Float[Array, "9"], rotation: Float[Array, "3 3"], origin: Float[Array, "3"], points: Float[Array, "n 3"]
) -> Float[Array, "n 2"]:
    camera = Geometry(lens[:2], lens[2:4], lens[4:], jnp.zeros(3), jnp.zeros(3))
    return project(camera, points @ rotation.T + origin)


_jitted_places = jax.jit(_places)


def _inside(state: RigState, pixels: Float[np.ndarray, "n 2"], margin: float) -> Bool[np.ndarray, " n"]:
    last = np.array([state.rig.camera.columns, state.rig.camera.rows]) - 1 - margin
    return np.asarray(np.all((pixels >= margin) & (pixels <= last), axis=1))


def _named(
    corners: Float[np.ndarray, "n 3"],
    markers: Float[np.ndarray, "m 3"],
    marked: Bool[np.ndarray, " markers"],
    spec: BoardSpec,
) -> Bool[np.ndarray, " n"]:
    """Corners both of whose markers are in the picture: without them the detector does not know their numbers."""
    middles = markers.reshape(-1, 4, 3).mean(axis=1)
    near = np.linalg.norm(corners[:, None] - middles, axis=2) < spec.square_mm
    return np.asarray((near & ~marked).sum(axis=1) == 0)
