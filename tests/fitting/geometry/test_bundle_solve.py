from __future__ import annotations

import jax
import numpy as np
import pytest

from tests.fitting.geometry.boards import sight
from tests.fitting.geometry.test_bundle import SCENE, arrays
from udccal.fitting.geometry.bundle_noise import covariance
from udccal.fitting.geometry.bundle_orders import free_intrinsics
from udccal.fitting.geometry.bundle_points import blocks, bucket, gather
from udccal.fitting.geometry.bundle_solve import NO_PRIOR, Bundle, Prior, linearised, solve
from udccal.fitting.geometry.bundle_start import best_poses, facing, starts
from udccal.models.geometry import project, rotation_matrix

EVERY = free_intrinsics((1, 1, 1, 1, 1))
POINTS = gather(*arrays()).points
TRUTH = Bundle(np.concatenate([SCENE.camera.focal, SCENE.camera.centre, SCENE.camera.distortion]), SCENE.poses)


def test_buckets_recur_and_are_never_too_small() -> None:
    sizes = [bucket(count) for count in range(1, 400)]
    assert all(size >= count for count, size in enumerate(sizes, 1))
    assert len(set(sizes)) == 15
    assert max(size / count for count, size in enumerate(sizes, 1) if count > 4) < 1.5


def test_padding_changes_nothing() -> None:
    padded = blocks(POINTS)
    assert padded.weight.shape == (8, 48)
    assert (padded.weight > 0).sum() == len(POINTS.board)
    np.testing.assert_array_equal(padded.image[padded.row, padded.column], POINTS.image)


def test_slopes_are_those_of_the_model() -> None:
    residuals, slopes = linearised(TRUTH, POINTS)
    with jax.enable_x64(True):
        matrix = np.asarray(rotation_matrix(SCENE.poses[2, :3]))
        mine = POINTS.view == 2
        there = POINTS.board[mine] @ matrix.T + SCENE.poses[2, 3:]
        np.testing.assert_allclose(residuals[mine], np.asarray(project(SCENE.camera, there)) - POINTS.image[mine])
    step = 1e-6 * np.array([1e3, 1e3, 1e3, 1e3, 1, 1, 1, 1, 1])
    for k in (0, 3, 4, 6, 8):
        nudge = step * (np.arange(9) == k)
        above = linearised(Bundle(TRUTH.intrinsics + nudge, TRUTH.poses), POINTS)[0]
        np.testing.assert_allclose((above - residuals) / step[k], slopes[:, :, k], rtol=1e-3, atol=1e-3)


def test_blockwise_covariance_is_the_inverse_of_the_whole() -> None:
    solved = solve(TRUTH, POINTS, EVERY, NO_PRIOR)
    _, slopes = linearised(solved.bundle, POINTS)
    size = 9 + 6 * len(POINTS.names)
    whole = np.zeros((len(POINTS.board), 2, size))
    whole[:, :, :9] = slopes[:, :, :9]
    for view in range(len(POINTS.names)):
        mine = np.flatnonzero(POINTS.view == view)
        whole[mine, :, 9 + 6 * view : 15 + 6 * view] = slopes[mine, :, 9:]
    tall = (whole / POINTS.sigma[:, None, None]).reshape(-1, size)
    unit = np.linalg.norm(tall, axis=0)
    expected = np.linalg.inv((tall / unit).T @ (tall / unit)) / np.outer(unit, unit)
    sigma = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        covariance(solved, EVERY) / np.outer(sigma, sigma), expected / np.outer(sigma, sigma), atol=1e-6
    )


def test_the_solver_stands_where_the_slope_vanishes() -> None:
    solved = solve(TRUTH, POINTS, EVERY, NO_PRIOR)
    residuals, slopes = linearised(solved.bundle, POINTS)
    slope = np.einsum("nai,na->i", slopes[..., :9], residuals / POINTS.sigma[:, None] ** 2)
    sigma = np.sqrt(np.diag(covariance(solved, EVERY))[:9])
    assert solved.converged
    assert np.abs(slope * sigma).max() < 0.01
    assert solved.iterations < 10


def test_held_coefficients_stay_and_have_no_sigma() -> None:
    free = free_intrinsics((1, 0, 0, 0, 0))
    start = Bundle(np.where(free, TRUTH.intrinsics, 0.0), TRUTH.poses)
    solved = solve(start, POINTS, free, NO_PRIOR)
    np.testing.assert_array_equal(solved.bundle.intrinsics[5:], 0.0)
    np.testing.assert_array_equal(np.diag(covariance(solved, free))[5:9], 0.0)


def test_a_prior_pulls_by_its_share() -> None:
    free = solve(TRUTH, POINTS, EVERY, NO_PRIOR)
    sigma = np.sqrt(covariance(free, EVERY)[0, 0])
    mean, precision = np.zeros(9), np.zeros(9)
    mean[0], precision[0] = free.bundle.intrinsics[0] + 2 * sigma, 1 / sigma**2
    pulled = solve(TRUTH, POINTS, EVERY, Prior(mean, precision))
    assert pulled.bundle.intrinsics[0] - free.bundle.intrinsics[0] == pytest.approx(sigma, rel=0.02)
    assert covariance(pulled, EVERY)[0, 0] == pytest.approx(sigma**2 / 2, rel=0.02)


def test_starting_poses_are_near_and_their_mirrors_are_not() -> None:
    first, second = best_poses(POINTS, TRUTH.intrinsics)
    np.testing.assert_allclose(first[:, 3:], SCENE.poses[:, 3:], rtol=0.02, atol=5.0)
    leaned = np.abs(SCENE.poses[1:, :2]).max(axis=1) > 0.2
    assert (np.linalg.norm(second - SCENE.poses, axis=1)[1:][leaned] > 0.1).all()


def test_the_first_focal_length_comes_from_the_views() -> None:
    begun = starts(POINTS, SCENE.size, None, None)
    assert len(begun) == 1
    np.testing.assert_allclose(begun[0].intrinsics[:2], 870.0, rtol=0.1)
    flat = gather(*arrays(sight(views=8, lean_rad=0.0, tilt_deg=0.0))).points
    assert np.isfinite(starts(flat, SCENE.size, None, None)[0].intrinsics).all()


def test_boards_behind_the_camera_are_turned_to_its_front() -> None:
    behind = SCENE.poses.copy()
    with jax.enable_x64(True):
        from scipy.spatial.transform import Rotation

        turned = Rotation.from_rotvec(behind[:, :3]) * Rotation.from_euler("z", 180, degrees=True)
    behind[:, :3], behind[:, 3:] = turned.as_rotvec(), -behind[:, 3:]
    np.testing.assert_allclose(facing(behind), facing(SCENE.poses), atol=1e-9)
