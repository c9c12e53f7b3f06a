"""Uncertainty of rays, and the tests of the model: each must speak up where it should, and only there."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.fitting.geometry.boards import calibrated, sight
from tests.fitting.geometry.test_bundle import SCENE, arrays
from udccal.board.charuco import board_points_mm
from udccal.errors import FitError
from udccal.fitting.geometry.bundle import ORDERS, Intrinsics, projected
from udccal.fitting.geometry.calibrated import CalibratedViews, Gauge, field_grid
from udccal.result import FitStatus

PIXELS = np.array([[511.0, 383.0], [40.0, 60.0], [980.0, 700.0]])


@pytest.fixture(scope="module")
def plain() -> CalibratedViews:
    board, image, sigma = arrays()
    return calibrated(board, image, SCENE.size, sigmas=sigma)


def trace(found: CalibratedViews, gauge: Gauge) -> np.ndarray:
    return np.einsum("nii->n", found.projection_covariance(PIXELS, gauge))


def test_rays_are_surer_the_less_they_are_fixed_to(plain: CalibratedViews) -> None:
    grid = field_grid(SCENE.size)
    rms = {gauge: np.sqrt(np.einsum("nii->n", plain.projection_covariance(grid, gauge)).mean()) for gauge in Gauge}
    assert rms[Gauge.ALIGNED] < rms[Gauge.BOARDS] < rms[Gauge.CAMERA]
    assert (trace(plain, Gauge.BOARDS) > 0).all()


def test_a_turn_of_camera_and_poses_together_moves_no_ray_of_the_boards(plain: CalibratedViews) -> None:
    """The freedom itself, as a covariance: the centre moves by a pixel and all boards turn to make up for it."""
    middle = plain.intrinsics.principal_point_px[None]
    _, slopes = projected(plain.intrinsics.vector, np.array([[0.0, 0.0, 1.0]]))
    direction = np.zeros(len(plain.cov))
    direction[2] = 1.0
    needed = -np.linalg.lstsq(slopes[0, :, 9:12], slopes[0, :, 2], rcond=None)[0]
    direction += np.linalg.pinv(plain.turn(Gauge.BOARDS)) @ needed
    certain = replace(plain, cov=np.outer(direction, direction))
    moved = [certain.projection_covariance(middle, gauge) for gauge in (Gauge.CAMERA, Gauge.BOARDS)]
    assert np.trace(moved[0][0]) == pytest.approx(1.0, rel=1e-6)
    assert np.trace(moved[1][0]) < 1e-12


def test_a_pattern_in_the_residuals_is_flagged_and_widens_the_rays(plain: CalibratedViews) -> None:
    """A ripple over the sensor that no lens of the model bends."""
    board, image, sigma = arrays()
    bent = [view + 0.3 * np.sin(view[:, ::-1] / 40.0) for view in image]
    found = calibrated(board, bent, SCENE.size, sigmas=sigma)
    assert found.pattern.p_value < 1e-3 < plain.pattern.p_value
    assert 0.03 < found.pattern_px < 0.4
    assert any("pattern over the picture" in note for note in found.notes)
    assert (trace(found, Gauge.ALIGNED) > trace(plain, Gauge.ALIGNED) + found.pattern_px**2).all()


def test_views_of_different_lenses_disagree_and_widen_all(plain: CalibratedViews) -> None:
    """Half of the views through a lens that squeezes, as when something was moved in between."""
    board, image, sigma = arrays()
    squeezed = [view + np.array([1.0, -1.0]) * 0.002 * (k % 2) * (view - 400) for k, view in enumerate(image)]
    found = calibrated(board, squeezed, SCENE.size, sigmas=sigma)
    assert found.disagreement.found
    assert not plain.disagreement.found
    assert found.cov[0, 0] > 4 * plain.cov[0, 0]
    assert any("disagree" in note and "may be off by more" in note for note in found.notes)


@pytest.mark.parametrize(
    ("bow_mm", "stretch", "told"), [(12.0, 1.0, "a bow along x of +12"), (0.0, 1.005, "a stretch along x of +0.5")]
)
def test_a_board_of_another_shape_is_fitted_and_named(bow_mm: float, stretch: float, told: str) -> None:
    """It biases the lens of every view alike: the scatter of the views does not hold that."""
    flat = board_points_mm(SCENE.spec)
    u = (2 * flat[:, 0] - flat[:, 0].min() - flat[:, 0].max()) / np.ptp(flat[:, 0])
    bent = flat * np.array([stretch, 1.0, 1.0]) + np.outer(bow_mm * (1 - u**2), [0.0, 0.0, 1.0])
    truth, pictures = Intrinsics.of_geometry(SCENE.camera).vector, SCENE.pictures(bent, np.random.default_rng(3))
    found = calibrated([flat] * len(pictures), pictures, SCENE.size)
    assert any(told in note for note in found.notes), found.notes
    assert not found.disagreement.found
    assert (np.abs(found.intrinsics.vector - truth)[:4] < 4.5 * np.sqrt(np.diag(found.cov))[:4]).all()


@pytest.mark.medium
def test_error_bars_of_views_that_disagree_are_those_of_drawn_lenses() -> None:
    """Boards bent by some mm, each differently: noise alone would give a third of the scatter."""
    scene = sight(views=12, sigma_px=0.06)
    flat = board_points_mm(scene.spec)
    u, v = ((flat - flat.mean(axis=0)) / np.ptp(flat[:, :2]))[:, :2].T
    truth = Intrinsics.of_geometry(scene.camera).vector
    plain = calibrated([flat] * 12, arrays(scene)[1], scene.size)
    z, noise_z = [], []
    for seed in range(30):
        rng, pictures = np.random.default_rng(seed), []
        for pose, seen, sigma in zip(scene.poses, scene.seen(), scene.sigma_px, strict=True):
            bent = flat + np.outer(12.0 * rng.standard_normal(3) @ [u * u, v * v, u * v], [0.0, 0.0, 1.0])
            there = Rotation.from_rotvec(pose[:3]).apply(bent) + pose[3:]
            exact = projected(truth, there)[0]
            pictures.append(np.where(seen[:, None], exact + sigma[:, None] * rng.standard_normal(exact.shape), np.nan))
        found = calibrated([flat] * 12, pictures, scene.size)
        assert found.disagreement.found
        free = np.array(found.free)
        z.append(((found.intrinsics.vector - truth) / np.sqrt(np.diag(found.cov)[:9] + ~free))[:4])
        scale = np.median(found.points.sigma) / np.median(plain.points.sigma)
        noise_z.append((found.intrinsics.vector - truth)[:4] / (scale * np.sqrt(np.diag(plain.cov)[:4])))
    assert 0.75 < np.sqrt(np.mean(np.square(z))) < 1.35
    assert np.sqrt(np.mean(np.square(noise_z))) > 2.5  # what the test must reject


def test_a_ray_has_a_covariance_wherever_the_lens_does_not_fold(plain: CalibratedViews) -> None:
    columns, rows = SCENE.size
    edges = np.array([[x, y] for x in (0.0, columns / 2, columns - 1.0) for y in (0.0, rows / 2, rows - 1.0)])
    assert np.isfinite(plain.projection_covariance(edges)).all()
    folded = replace(
        plain, intrinsics=Intrinsics(np.full(2, 400.0), np.array([511.5, 383.5]), np.array([-0.5, 0, 0, 0, 0]))
    )
    assert np.isfinite(folded.projection_covariance(edges[4:5])).all()
    with pytest.raises(FitError, match=r"distortion folds"):
        folded.projection_covariance(edges)
    with pytest.raises(FitError, match=r"distortion folds"):
        plain.projection_covariance(np.array([[np.nan, 3.0]]))


# Visible: by eight sigma or more, where all five are free.
VISIBLE = {
    "no distortion": (0.0, 0.0, 0.0, 0.0, 0.0),
    "k1": (-0.07, 0.0, 0.0, 0.0, 0.0),
    "k1 k2": (-0.12, 0.2, 0.0, 0.0, 0.0),
    "k1 k2 k3": (-0.12, 0.2, 0.0, 0.0, -0.25),
    "k1 k2 p1 p2": (-0.12, 0.2, 1e-3, -1e-3, 0.0),
    "k1 k2 p1 p2 k3": (-0.12, 0.2, 1e-3, -1e-3, -0.25),
}


@pytest.mark.slow
@pytest.mark.parametrize("order", list(VISIBLE))
def test_the_right_order_is_chosen_in_95_of_100(order: str) -> None:
    scene, right = sight(views=8, distortion=np.array(VISIBLE[order]), sigma_px=0.06), 0
    for seed in range(100):
        board, image, sigma = arrays(scene, seed)
        found = calibrated(board, image, scene.size, sigmas=sigma)
        right += next(c.name for c in found.candidates if c.chosen) == order
    assert right >= 95
    assert order in ORDERS


# Steps of a descent that leads nowhere may overflow; the solver takes them back.
@pytest.mark.medium
@pytest.mark.filterwarnings("ignore:overflow encountered")
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("weighted", [False, True])
def test_random_corners_are_a_poor_fit(seed: int, weighted: bool) -> None:
    """Without sigmas only the residuals' size in px can tell; with sigmas the status is the same."""
    rng, scene = np.random.default_rng([seed, 31]), sight(views=8)
    board = [board_points_mm(scene.spec)] * 8
    image = [rng.uniform((0, 0), scene.size, (len(board[0]), 2)) for _ in board]
    sigmas = [np.full(len(board[0]), 0.1) for _ in board] if weighted else None
    found = calibrated(board, image, scene.size, sigmas=sigmas)
    assert found.status is FitStatus.POOR_FIT
    assert "order of the board" in " ".join(found.notes)


def test_coarse_corners_of_a_real_board_are_no_poor_fit() -> None:
    """Corners to 2 px, as of a quick detector on a large picture, still calibrate."""
    scene = sight(views=8, sigma_px=2.0)
    views = scene.views(np.random.default_rng(3))
    points = board_points_mm(scene.spec)
    found = calibrated([points[v.corners.ids] for v in views], [v.corners.xy for v in views], scene.size)
    assert found.status is FitStatus.CONVERGED


@pytest.mark.medium
def test_sigmas_hold_where_small_coefficients_are_dropped() -> None:
    """Tangential terms that BIC drops in most draws move the centre by twice the sigma of one order."""
    z = []
    for seed in range(12):
        small = np.random.default_rng([seed, 5]).normal(0, 4e-4, 2)
        scene = sight(seed=seed, views=6, distortion=np.array([-0.1, 0.02, *small, 0.0]), sigma_px=0.2)
        boards, images, _ = arrays(scene, seed)
        found = calibrated(boards, images, scene.size)
        centre = np.array(found.intrinsics.principal_point_px)
        z.append((centre - scene.camera.principal_point_px) / np.sqrt(np.diag(found.cov)[2:4]))
    assert np.sqrt(np.mean(np.square(z))) < 1.6


@pytest.mark.medium
@pytest.mark.parametrize("far", [{}, {"quadrant": True, "distance_mm": (1500.0, 2500.0)}])
def test_sigmas_hold_whether_a_lens_has_a_coefficient_or_not(far: dict[str, Any]) -> None:
    """Half of the lenses have no p1 and p2, or no k3; of the others, many have small ones. Views are few or many."""
    z = []
    for seed in range(40):
        rng = np.random.default_rng([seed, 77])
        tangential, last = rng.uniform(size=2) < 0.5
        size = rng.choice([1.0, 0.3, 0.1], 2)
        bend = [-0.07, 0.035, *rng.normal(0, 1e-3, 2) * tangential * size[0], rng.normal(0, 0.1) * last * size[1]]
        scene = sight(seed=seed, views=int(rng.integers(5, 14)), distortion=np.array(bend), **far)
        found = calibrated(*arrays(scene, seed)[:2], scene.size)
        off = found.intrinsics.vector - Intrinsics.of_geometry(scene.camera).vector
        z.append(off / np.sqrt(np.diag(found.cov)[: len(off)]))
    assert np.abs(z).max() < 4.5
    assert (np.sqrt(np.mean(np.square(z), axis=0)) < 1.4).all()


def test_pictures_that_are_given_twice_do_not_count_twice(plain: CalibratedViews) -> None:
    """Copies that a codec has changed by a thousandth of a pixel: k3 was 5 sigma off, and a lens was blamed."""
    board, image, sigma = arrays()
    rng = np.random.default_rng(3)
    copied = [view + 1e-3 * rng.standard_normal(view.shape) for view in image for _ in range(4)]
    four = [[part for part in parts for _ in range(4)] for parts in (board, sigma)]
    found = calibrated(four[0], copied, SCENE.size, sigmas=four[1])
    (left_out,) = (one for one in found.outliers if "repeats another's corners" in one.rule)
    assert left_out.count == 3 * len(image)
    assert found.cov[0, 0] == pytest.approx(plain.cov[0, 0], rel=0.05)
    # Pictures of a board at rest, with noise of their own, are measurements.
    again = [part + s[:, None] * rng.standard_normal(part.shape) for part, s in zip(image, sigma, strict=True)]
    twice = calibrated([*board, *board], [*image, *again], SCENE.size, sigmas=[*sigma, *sigma])
    assert not any("repeats" in one.rule for one in twice.outliers)
    with pytest.raises(FitError, match="at least 3 different views, found 2, and 6 that repeat them"):
        calibrated(four[0][:8], copied[:8], SCENE.size, sigmas=four[1][:8])
