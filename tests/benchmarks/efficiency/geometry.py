"""Geometry from a session-like set of boards, over drawn lenses and mountings, and realisations of the corners' noise.

Eleven views of 48 corners, one of them parallel to the panel, a lens with five distortion coefficients of visible size
and corners whose sigma differ by a factor of three. Two kinds of rays are followed: fixed to the panel, as restoration
needs them, and fixed to nothing, that is after the best common rotation, as lenses are compared.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tests.benchmarks.efficiency.trials import Trials
from tests.fitting.geometry.boards import VISIBLE_BEND, Sight, calibrated, sight
from tests.scenes.information import fisher_information
from udccal.board.charuco import board_points_mm
from udccal.fitting.engine.gaussian import cramer_rao
from udccal.fitting.geometry.bundle import LENS, Intrinsics
from udccal.fitting.geometry.calibrated import CalibratedViews, Gauge, field_grid
from udccal.fitting.geometry.data import GeometryData
from udccal.fitting.geometry.fit import fit_boards, projection_sigma_px
from udccal.models.geometry import Geometry, project, rotation_matrix
from udccal.numerics import in_float64
from udccal.result import FitResult

_LENSES, _REALISATIONS = 40, 10
# Ten sigma: of seven, one fit in forty still leaves it out, and the error of that one is as large as it is.
_VISIBLE_K3 = 0.15
_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "tilt_deg", "roll_deg", "yaw_deg")
# Fractions of the picture's width and height.
_FIELD = np.array([[0.5, 0.5], [0.05, 0.05], [0.95, 0.1], [0.1, 0.9], [0.75, 0.7]])
# A corner outside the picture tells nothing.
_UNSEEN_PX2 = 1e12
_START = Geometry(np.full(2, 850.0), np.array([511.5, 383.5]), np.zeros(5), np.zeros(3), np.zeros(3))


def corners_seen(
    x: Float[Array, " n"], board: Float[Array, "corners 3"], variance: Float[Array, " samples"]
) -> tuple[Float[Array, " samples"], Float[Array, " samples"]]:
    """Mean and variance of all coordinates; ``x`` is the intrinsics and the poses."""
    camera = _camera(x)

    def one(pose: Float[Array, "6"]) -> Float[Array, "corners 2"]:
        return project(camera, board @ rotation_matrix(pose[:3]).T + pose[3:])

    return jax.vmap(one)(x[LENS:].reshape(-1, 6)).ravel(), variance


def _camera(x: Float[Array, " n"]) -> Geometry:
    return Intrinsics.of(x).camera()


def _angles_deg(x: Float[Array, " n"]) -> Float[Array, "3"]:
    """(tilt, roll, yaw) of the camera against the parallel board, the first."""
    panel_camera = rotation_matrix(x[LENS : LENS + 3]).T
    tilt, roll = jnp.arcsin(panel_camera[1, 2]), jnp.arctan2(panel_camera[1, 0], panel_camera[1, 1])
    return jnp.rad2deg(jnp.stack([tilt, roll, jnp.arctan2(panel_camera[0, 2], panel_camera[2, 2])]))


def _landed(x: Float[Array, " n"], directions: Float[Array, "rays 3"]) -> Float[Array, " coordinates"]:
    """Where directions fixed to the parallel board land."""
    return project(_camera(x), directions @ rotation_matrix(x[LENS : LENS + 3]).T).ravel()


def _lens_alone(x: Float[Array, " n"], rays: Float[Array, "rays 3"]) -> Float[Array, " coordinates"]:
    """Where rays fixed to the camera land."""
    return project(_camera(x), rays).ravel()


def trials(share: float = 1.0) -> list[Trials]:
    """Realisations of the intrinsics, the mounting and where rays land, of lenses that are drawn."""
    count = max(2, round(_LENSES * share))
    lenses = [_of_lens(seed) for seed in range(count)]
    number = np.repeat(np.arange(count), _REALISATIONS)
    numbers, by_panel, aligned = (np.concatenate([lens[part] for lens in lenses], axis=1) for part in range(3))
    return [
        *(Trials(f"geometry/{name}", *numbers[:, :, [k]], truth=number) for k, name in enumerate(_NAMES)),
        Trials("geometry/ray of the panel", *by_panel, truth=number),
        Trials("geometry/ray of the lens", *aligned, truth=number),
    ]


def _drawn(seed: int) -> Sight:
    """Another lens, mounting, boards and corners' noise; every coefficient is of a size that the fit sees.

    Where one is too small for that, the fit leaves it out, and the bound of a lens that has it does not hold.
    """
    rng = np.random.default_rng([seed, 0x6E])
    focal, aspect = rng.uniform(800.0, 950.0), rng.normal(1.0, 2e-4)
    bend = np.append(VISIBLE_BEND[:4], _VISIBLE_K3) * rng.uniform(0.8, 1.2, 5)
    return sight(
        seed=seed,
        views=11,
        tilt_deg=rng.uniform(5.0, 30.0),
        distortion=bend,
        focal_px=(focal, focal * aspect),
        centre_px=(rng.uniform(505.0, 518.0), rng.uniform(378.0, 389.0)),
    )


@in_float64
def _of_lens(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(error, sigma, bound) by realisation: of the numbers, of rays of the panel, and of rays of the lens."""
    scene = _drawn(seed)
    truth = np.append(Intrinsics.of_geometry(scene.camera).vector, scene.poses.ravel())
    board = board_points_mm(scene.spec)
    variance = np.repeat(np.where(scene.seen(), scene.sigma_px**2, _UNSEEN_PX2).ravel(), 2)
    information = fisher_information(corners_seen, truth, board, variance)
    pixels = _FIELD * np.array(scene.size)
    rays = _rays(scene, pixels)
    turned = rays @ np.asarray(rotation_matrix(scene.poses[0, :3]))
    slopes = np.vstack([np.eye(len(truth))[:LENS], jax.jacfwd(_angles_deg)(truth)])
    grid = field_grid(scene.size)
    grid_rays = _rays(scene, grid)
    bounds = (
        cramer_rao(information, slopes),
        cramer_rao(information, np.asarray(jax.jacfwd(_landed)(truth, turned))),
        cramer_rao(information, _without_turn(np.asarray(jax.jacfwd(_lens_alone)(truth, grid_rays)), scene, grid)),
    )
    values = np.concatenate([truth[:LENS], np.asarray(_angles_deg(truth))])
    found: list[list[tuple[np.ndarray, np.ndarray]]] = [[], [], []]
    rng = np.random.default_rng([seed, 4])
    for _ in range(_REALISATIONS):
        views = scene.views(rng)
        result = fit_boards(GeometryData(tuple(views), _START, scene.size)).or_raise()
        ids = [view.corners.ids for view in views]
        sigmas = [scene.sigma_px[k, seen] for k, seen in enumerate(ids)]
        bundle = calibrated([board[i] for i in ids], [v.corners.xy for v in views], scene.size, None, sigmas)
        found[0].append(_parameters(result, values))
        found[1].append(_panel_rays(result, turned, pixels))
        found[2].append(_lens_rays(bundle, grid_rays, grid))
    parts = []
    for bound, pairs in zip(bounds, found, strict=True):
        error, sigma = (np.array([pair[k] for pair in pairs]) for k in range(2))
        parts.append(np.stack([error, sigma, np.broadcast_to(bound, error.shape)]))
    return parts[0], parts[1], parts[2]


def _rays(scene: Sight, pixels: Float[np.ndarray, "rays 2"]) -> Float[np.ndarray, "rays 3"]:
    """Through pixels, in camera coordinates, by Newton's method on the truth."""
    ideal = (pixels - scene.camera.principal_point_px) / scene.camera.focal_px
    for _ in range(40):
        rays = np.concatenate([ideal, np.ones((len(ideal), 1))], axis=1)
        ideal = ideal - (np.asarray(project(scene.camera, rays)) - pixels) / scene.camera.focal_px
    return np.concatenate([ideal, np.ones((len(ideal), 1))], axis=1)


def _turns(camera: Geometry, rays: Float[np.ndarray, "rays 3"]) -> Float[np.ndarray, "coordinates 3"]:
    """How the rays' places move with a small rotation."""
    return np.asarray(jax.jacfwd(lambda w: project(camera, rays @ rotation_matrix(w).T).ravel())(np.zeros(3)))


def _without_turn(slopes: np.ndarray, scene: Sight, grid: np.ndarray) -> np.ndarray:
    """Less what a rotation over the grid can undo."""
    turns = _turns(scene.camera, _rays(scene, grid))
    return slopes - turns @ np.linalg.lstsq(turns, slopes, rcond=None)[0]


def _parameters(result: FitResult[Geometry], truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    estimates = [result.estimate(name) for name in _NAMES]
    return np.array([e.value for e in estimates]) - truth, np.array([e.sigma for e in estimates])


def _panel_rays(result: FitResult[Geometry], turned: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    seen = np.asarray(project(result.term, turned @ np.asarray(rotation_matrix(result.term.rotation_rad))))
    return (seen - pixels).ravel(), projection_sigma_px(result, seen).ravel()


def _lens_rays(bundle: CalibratedViews, rays: np.ndarray, grid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    camera = bundle.intrinsics.camera()
    turn = np.zeros(3)
    for _ in range(4):
        now = rays @ np.asarray(rotation_matrix(turn)).T
        error = (np.asarray(project(camera, now)) - grid).ravel()
        # Turns are small: one after another they add.
        turn = turn - np.linalg.lstsq(_turns(camera, now), error, rcond=None)[0]
    cov = bundle.projection_covariance(grid, Gauge.ALIGNED)
    return error, np.sqrt(np.einsum("nii->ni", cov)).ravel()
