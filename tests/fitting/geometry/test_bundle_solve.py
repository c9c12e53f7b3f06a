from __future__ import annotations

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.fitting.geometry.boards import sight
from tests.fitting.geometry.test_bundle import SCENE, arrays
from udccal.errors import FitError
from udccal.fitting.engine.gaussian import Prior
from udccal.fitting.geometry.bundle import (
    EVERY,
    ORDERS,
    Bundle,
    Intrinsics,
    Solved,
    linearised,
    solve,
)
from udccal.fitting.geometry.data import best_poses, gather
from udccal.fitting.geometry.views import starts
from udccal.models.geometry import project, rotation_matrix

POINTS = gather(*arrays()).points
TRUTH = Bundle(Intrinsics.of_geometry(SCENE.camera).vector, SCENE.poses)
NO_PRIOR = Prior(np.zeros(9), np.zeros((0, 9)))


@pytest.fixture(scope="module")
def solved() -> Solved:
    return solve(TRUTH, POINTS, EVERY, NO_PRIOR)


def test_the_packing_is_one_and_goes_both_ways() -> None:
    lens = Intrinsics.of(np.arange(9.0))
    np.testing.assert_array_equal(lens.vector, np.arange(9.0))
    np.testing.assert_array_equal(lens.camera().distortion, [4.0, 5.0, 6.0, 7.0, 8.0])
    np.testing.assert_array_equal(lens.opencv[0], [[0, 0, 2], [0, 1, 3], [0, 0, 1]])
    assert [int(free.sum()) for free in ORDERS.values()] == [4, 5, 6, 7, 8, 9]


@pytest.mark.medium
def test_places_and_slopes_are_those_of_the_model() -> None:
    """OpenCV's Jacobian against the term's own projection, traced by JAX, in all 15 directions."""
    residuals, slopes = linearised(TRUTH, POINTS)
    mine = POINTS.view == 2
    board = POINTS.board[mine]

    def seen(x: jax.Array) -> jax.Array:
        return project(Intrinsics.of(x[:9]).camera(), board @ rotation_matrix(x[9:12]).T + x[12:])

    with jax.enable_x64(True):
        x = np.concatenate([TRUTH.intrinsics, SCENE.poses[2]])
        np.testing.assert_allclose(residuals[mine], np.asarray(seen(x)) - POINTS.image[mine], atol=1e-9)
        expected = np.asarray(jax.jacfwd(seen)(x))
    np.testing.assert_allclose(slopes[mine], expected, rtol=1e-8, atol=1e-8 * np.abs(expected).max())


def test_blockwise_covariance_is_the_inverse_of_the_whole(solved: Solved) -> None:
    _, slopes = linearised(solved.place, POINTS)
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
    found = solved.equations.joint_cov()
    np.testing.assert_allclose(found / np.outer(sigma, sigma), expected / np.outer(sigma, sigma), atol=1e-6)


def test_the_solver_stands_where_the_slope_vanishes(solved: Solved) -> None:
    residuals, slopes = linearised(solved.place, POINTS)
    slope = np.einsum("nai,na->i", slopes[..., :9], residuals / POINTS.sigma[:, None] ** 2)
    assert solved.converged
    assert np.abs(slope * np.sqrt(np.diag(solved.equations.cov()))).max() < 0.01
    assert solved.iterations < 10


def test_held_coefficients_stay_and_have_no_sigma() -> None:
    free = ORDERS["k1"]
    found = solve(Bundle(np.where(free, TRUTH.intrinsics, 0.0), TRUTH.poses), POINTS, free, NO_PRIOR)
    np.testing.assert_array_equal(found.place.intrinsics[5:], 0.0)
    np.testing.assert_array_equal(np.diag(found.equations.joint_cov())[5:9], 0.0)


def test_a_prior_pulls_by_its_share(solved: Solved) -> None:
    sigma = np.sqrt(solved.equations.cov()[0, 0])
    mean, width = np.zeros(9), np.full(9, np.inf)
    mean[0], width[0] = solved.place.intrinsics[0] + 2 * sigma, sigma
    pulled = solve(TRUTH, POINTS, EVERY, Prior.independent(mean, width))
    assert pulled.place.intrinsics[0] - solved.place.intrinsics[0] == pytest.approx(sigma, rel=0.02)
    assert pulled.equations.cov()[0, 0] == pytest.approx(sigma**2 / 2, rel=0.02)


def test_what_exact_parallel_boards_do_not_tell_is_very_unsure() -> None:
    """All boards of one orientation, without noise: focal length and distance are one unknown."""
    poses = SCENE.poses.copy()
    poses[:, :3] = 0.0
    places = linearised(Bundle(TRUTH.intrinsics, poses), POINTS)[0] + POINTS.image
    board, view = POINTS.board, POINTS.view
    parallel = gather([board[view == k] for k in range(8)], [places[view == k] for k in range(8)]).points
    found = solve(Bundle(TRUTH.intrinsics, poses), parallel, EVERY, NO_PRIOR)
    assert np.sqrt(found.equations.joint_cov()[0, 0]) > 0.05 * TRUTH.intrinsics[0]


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
    turned = Rotation.from_rotvec(behind[:, :3]) * Rotation.from_euler("z", 180, degrees=True)
    behind[:, :3], behind[:, 3:] = turned.as_rotvec(), -behind[:, 3:]
    turned_back, front = (Bundle(TRUTH.intrinsics, poses).facing().poses for poses in (behind, SCENE.poses))
    np.testing.assert_allclose(turned_back, front, atol=1e-9)


def test_corners_come_in_the_shapes_that_opencv_gives() -> None:
    board, image, sigma = arrays()
    stacked = [view.astype(np.float32)[:, None] for view in board], [view[:, None] for view in image], sigma
    again = gather(*stacked).points
    np.testing.assert_array_equal(again.image, POINTS.image)
    np.testing.assert_array_equal(again.board, POINTS.board)


def test_arrays_that_do_not_belong_together_are_refused() -> None:
    board, image, sigma = arrays()
    with pytest.raises(FitError, match="as many views"):
        gather(board[1:], image, sigma)
    with pytest.raises(FitError, match=r"view 3, found \(48, 3\), \(47, 2\)"):
        gather(board, [*image[:3], image[3][1:], *image[4:]])
    with pytest.raises(FitError, match="view 0"):
        gather(board, [view.T for view in image])
    with pytest.raises(FitError, match="sigmas of view 1 without masked entries, found 1 of 96 masked"):
        gather(board, [image[0], np.ma.masked_equal(image[1], image[1][5, 0]), *image[2:]])
    with pytest.raises(FitError, match="Expected numbers in view 0, found"):
        gather([board[0] + 1j, *board[1:]], image)
