"""Bundle adjustment: intrinsics, distortion and one pose per view from points of known position on a flat board.

Array functions only: corners from a ChArUco board through a panel and from a chessboard in a plain photograph alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from udccal.errors import FitError
from udccal.fitting.result import Candidate
from udccal.fitting.solvers import Solution, least_squares
from udccal.models.arrays import Arrayish
from udccal.models.geometry import Geometry, project, rotation_matrix
from udccal.numerics import in_float64

# Distortion orders, simplest first: which of (k1, k2, p1, p2, k3) are free.
ORDERS = (
    ("no distortion", (0, 0, 0, 0, 0)),
    ("k1", (1, 0, 0, 0, 0)),
    ("k1 k2", (1, 1, 0, 0, 0)),
    ("k1 k2 p1 p2", (1, 1, 1, 1, 0)),
    ("k1 k2 p1 p2 k3", (1, 1, 1, 1, 1)),
)
INTRINSIC_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
# Corners further from the model than this many robust sigma of their view are left out, then all is refit.
OUTLIER_SIGMA = 5.0
_MAX_OUTLIER_ROUNDS = 4
_MIN_VIEWS = 3
_MIN_POINTS = 6
# A corner's own sigma says little about what the saddle leaves out; this is added to it in quadrature.
_SIGMA_FLOOR_PX = 0.04


@dataclass(frozen=True)
class CalibratedViews:
    """Intrinsics and poses; ``cov`` is of (fx, fy, cx, cy, k1, k2, p1, p2, k3, then 6 per view), scaled by residuals.

    A pose takes board coordinates to camera coordinates: rotation vector (rad), then translation (board's unit).
    ``used`` and ``residuals_px`` follow the points of all views one after another; ``view`` says whose they are.
    """

    focal: Float[np.ndarray, "2"]
    centre: Float[np.ndarray, "2"]
    distortion: Float[np.ndarray, "5"]
    poses: Float[np.ndarray, "views 6"]
    cov: Float[np.ndarray, "n n"]
    residuals_px: Float[np.ndarray, "points 2"]
    view: Int[np.ndarray, " points"]
    used: Bool[np.ndarray, " points"]
    free: tuple[bool, ...]
    chi2_dof: float
    candidates: tuple[Candidate, ...]
    iterations: int
    converged: bool

    @property
    def rms_px(self) -> float:
        """Root of the mean squared distance between seen and projected points, as OpenCV's calibrateCamera counts."""
        return float(np.sqrt((self.residuals_px[self.used] ** 2).sum(axis=1).mean()))


@dataclass(frozen=True)
class _Points:
    board: Float[np.ndarray, "points 3"]
    image: Float[np.ndarray, "points 2"]
    sigma: Float[np.ndarray, " points"]
    view: Int[np.ndarray, " points"]
    used: Bool[np.ndarray, " points"]


def _residuals(
    x: Float[Array, " n"],
    board: Float[Arrayish, "points 3"],
    image: Float[Arrayish, "points 2"],
    weight: Float[Arrayish, " points"],
    view: Int[Arrayish, " points"],
) -> Float[Array, " m"]:
    camera = Geometry(x[:2], x[2:4], x[4:9], jnp.zeros(3), jnp.zeros(3))
    poses = x[9:].reshape(-1, 6)
    rotations = jax.vmap(rotation_matrix)(poses[:, :3])
    points = jnp.einsum("nij,nj->ni", rotations[view], board) + poses[view, 3:]
    return ((project(camera, points) - image) * jnp.asarray(weight)[:, None]).ravel()


def calibrate_views(
    object_points: Sequence[Float[np.ndarray, "_ 3"]],
    image_points: Sequence[Float[np.ndarray, "_ 2"]],
    image_size: tuple[int, int],
    start: Geometry | None = None,
    sigmas: Sequence[Float[np.ndarray, " _"]] | None = None,
) -> CalibratedViews:
    """Calibrate a camera from views of flat boards.

    Args:
        object_points: per view, points on the board (z = 0) in any unit of length.
        image_points: per view, the same points in px, (0, 0) the centre of the top-left pixel.
        image_size: (columns, rows).
        start: intrinsics to start from; without it they come from the views' vanishing points (Zhang, 2000).
        sigmas: per view, one sigma in px of each point; without it all points count alike.

    The order of the distortion is the one with the lowest BIC (Schwarz, 1978) on the points that remain after
    outliers are left out. The covariance is scaled so that chi2 per degree of freedom is one.

    Raises:
        FitError: with fewer than 3 views, or a view of fewer than 6 points.
    """
    _check(object_points, image_points)
    points = _gather(object_points, image_points, sigmas)
    origin = _start(object_points, image_points, image_size, start)
    full, points = _solve_without_outliers(origin, points, ORDERS[-1][1])
    solutions, scores = [], []
    for name, free in ORDERS:
        last = name == ORDERS[-1][0]
        solution = full if last else _solve(_frozen(full.x, free), points, free)
        parameters = 4 + sum(free) + 6 * len(object_points)
        solutions.append(solution)
        scores.append(Candidate(name, parameters, _bic(solution, points, parameters), chosen=False))
    best = min(range(len(scores)), key=lambda k: scores[k].criterion)
    scores[best] = replace(scores[best], chosen=True)
    return _result(solutions[best], points, ORDERS[best][1], tuple(scores))


def _check(object_points: Sequence[np.ndarray], image_points: Sequence[np.ndarray]) -> None:
    counts = [min(len(a), len(b)) for a, b in zip(object_points, image_points, strict=True)]
    if len(counts) < _MIN_VIEWS or min(counts) < _MIN_POINTS:
        raise FitError(
            f"Expected at least {_MIN_VIEWS} views of at least {_MIN_POINTS} points each, found {len(counts)} views "
            f"with {', '.join(map(str, counts)) or 'no'} points. Capture more views of the board."
        )


def _gather(board: Sequence[np.ndarray], image: Sequence[np.ndarray], sigmas: Sequence[np.ndarray] | None) -> _Points:
    count = [len(p) for p in board]
    own = np.concatenate(sigmas) if sigmas is not None else np.full(sum(count), 0.1)
    return _Points(
        board=np.concatenate(board).astype(np.float64),
        image=np.concatenate(image).astype(np.float64),
        sigma=np.hypot(own, _SIGMA_FLOOR_PX),
        view=np.repeat(np.arange(len(board)), count),
        used=np.ones(sum(count), dtype=bool),
    )


def _start(
    board: Sequence[np.ndarray], image: Sequence[np.ndarray], size: tuple[int, int], start: Geometry | None
) -> Float[np.ndarray, " n"]:
    single = [np.ascontiguousarray(p, dtype=np.float32) for p in image]
    flat = [np.ascontiguousarray(p, dtype=np.float32) for p in board]
    if start is None:
        matrix = cv2.initCameraMatrix2D(flat, single, size)
        focal, centre = np.diag(matrix)[:2], matrix[:2, 2]
        distortion = np.zeros(5)
    else:
        focal, centre = np.asarray(start.focal, dtype=np.float64), np.asarray(start.centre, dtype=np.float64)
        distortion = np.asarray(start.distortion, dtype=np.float64)
    matrix = np.array([[focal[0], 0, centre[0]], [0, focal[1], centre[1]], [0, 0, 1.0]])
    poses = []
    for points, pixels in zip(flat, single, strict=True):
        _, rotation, translation = cv2.solvePnP(points, pixels, matrix, distortion)
        poses.append(np.concatenate([rotation.ravel(), translation.ravel()]))
    return np.concatenate([focal, centre, distortion, *poses]).astype(np.float64)


def _frozen(x: Float[np.ndarray, " n"], free: tuple[int, ...]) -> Float[np.ndarray, " n"]:
    held = x.copy()
    held[4:9] *= np.array(free, dtype=np.float64)
    return held


def _solve(start: Float[np.ndarray, " n"], points: _Points, free: tuple[int, ...]) -> Solution:
    """A parameter that is held has no scale, so the solver cannot move it."""
    views = (len(start) - 9) // 6
    distance = np.abs(start[9:].reshape(-1, 6)[:, 5]).mean()
    lens = np.array([1.0, 1.0, 1.0, 1.0]) * 1e-3 * start[0]
    bend = np.array([1e-2, 1e-2, 1e-3, 1e-3, 1e-2]) * np.array(free)
    pose = np.array([1e-3, 1e-3, 1e-3, 1e-3 * distance, 1e-3 * distance, 1e-3 * distance])
    scale = np.concatenate([lens, bend, np.tile(pose, views)])
    weight = points.used / points.sigma
    return least_squares(
        _residuals, start, scale, points.board, points.image, weight, points.view, max_iterations=30, tolerance=1e-8
    )


def _solve_without_outliers(
    start: Float[np.ndarray, " n"], points: _Points, free: tuple[int, ...]
) -> tuple[Solution, _Points]:
    """Each view has its own scatter (blur, light, distance): sigma is scaled, and outliers are judged, view by view."""
    solution = _solve(start, points, free)
    own = points.sigma
    for _ in range(_MAX_OUTLIER_ROUNDS):
        offset = np.linalg.norm(_residuals_px(solution.x, points), axis=1)
        sigma = own * _scatter(offset / own, points)[points.view]
        used = offset <= OUTLIER_SIGMA * sigma
        settled = (used == points.used).all() and np.allclose(sigma, points.sigma, rtol=0.1)
        if settled:
            break
        points = replace(points, used=used, sigma=sigma)
        solution = _solve(solution.x, points, free)
    return solution, points


def _scatter(offset: Float[np.ndarray, " points"], points: _Points) -> Float[np.ndarray, " views"]:
    """Robust sigma per view: the length of a two-dimensional normal deviate has the median 1.1774 sigma."""
    views = range(int(points.view.max()) + 1)
    medians = [np.median(offset[(points.view == view) & points.used]) for view in views]
    return np.maximum(np.array(medians) / 1.1774, 1e-6)


_compiled_residuals = jax.jit(_residuals)


@in_float64
def _residuals_px(x: Float[np.ndarray, " n"], points: _Points) -> Float[np.ndarray, "points 2"]:
    flat = _compiled_residuals(x, points.board, points.image, np.ones(len(points.board)), points.view)
    return np.asarray(flat, dtype=np.float64).reshape(-1, 2)


def _bic(solution: Solution, points: _Points, parameters: int) -> float:
    """n log(chi2 / n) + k log n: the noise is estimated, too."""
    n = 2 * int(points.used.sum())
    return float(n * np.log(max(solution.chi2, 1e-300) / n) + parameters * np.log(n))


def _result(
    solution: Solution, points: _Points, free: tuple[int, ...], candidates: tuple[Candidate, ...]
) -> CalibratedViews:
    parameters = next(c.parameters for c in candidates if c.chosen)
    chi2_dof = solution.chi2 / max(2 * int(points.used.sum()) - parameters, 1)
    x = solution.x
    return CalibratedViews(
        focal=x[:2],
        centre=x[2:4],
        distortion=x[4:9],
        poses=x[9:].reshape(-1, 6),
        cov=solution.cov * chi2_dof,
        residuals_px=_residuals_px(x, points),
        view=points.view,
        used=points.used,
        free=(True,) * 4 + tuple(bool(f) for f in free),
        chi2_dof=float(chi2_dof),
        candidates=candidates,
        iterations=solution.iterations,
        converged=solution.converged,
    )
