"""Calibration from arrays: what goes wrong with points and views, and where it may start from."""

from __future__ import annotations

import inspect
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, example, given, settings
from hypothesis import strategies as st

from tests.fitting.geometry.boards import VISIBLE_BEND, Sight, calibrated, sight
from udccal.board.charuco import board_points_mm
from udccal.errors import FitError
from udccal.fitting.engine.gaussian import Posterior, Prior
from udccal.fitting.geometry.bundle import GeometryRules, Intrinsics
from udccal.fitting.geometry.calibrated import CalibratedViews
from udccal.fitting.geometry.data import gather
from udccal.fitting.geometry.fit import fit_geometry, projection_sigma_px
from udccal.fitting.geometry.views import check_picture
from udccal.models.geometry import Geometry
from udccal.result import FitStatus

SCENE = sight(views=8)
NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")


def arrays(scene: Sight = SCENE, seed: int = 1) -> tuple[list[np.ndarray], list[np.ndarray], list[np.ndarray]]:
    """Points on the board, in the picture (NaN outside it), and sigma."""
    rng = np.random.default_rng(seed)
    exact = scene.corners_px()
    seen = exact + scene.sigma_px[..., None] * rng.standard_normal(exact.shape)
    seen[~scene.seen()] = np.nan
    return [board_points_mm(scene.spec)] * len(exact), list(seen), list(scene.sigma_px)


def calibrate(scene: Sight = SCENE, **options: object) -> CalibratedViews:
    board, image, sigma = arrays(scene)
    return calibrated(board, image, scene.size, sigmas=sigma, **options)


def errors(found: CalibratedViews, scene: Sight = SCENE) -> np.ndarray:
    """Of the free intrinsics, in sigma."""
    truth = np.concatenate([scene.camera.focal_px, scene.camera.principal_point_px, scene.camera.distortion])
    free = np.array(found.free)
    return ((found.intrinsics.vector - truth) / np.sqrt(np.maximum(np.diag(found.cov)[:9], 1e-300)))[free]


@pytest.fixture(scope="module")
def plain() -> CalibratedViews:
    return calibrate()


def test_the_lens_is_found_within_its_sigma(plain: CalibratedViews) -> None:
    assert plain.status is FitStatus.CONVERGED
    assert next(c.name for c in plain.candidates if c.chosen) == "k1 k2 p1 p2"
    assert np.abs(errors(plain)).max() < 4
    assert plain.chi2_dof == pytest.approx(1.0, abs=0.15)
    assert not plain.disagreement.found
    assert not plain.pattern.found


@pytest.mark.parametrize("factor", [0.3, 0.8, 1.2, 4.0])
@pytest.mark.medium
def test_any_start_leads_to_the_same_lens(plain: CalibratedViews, factor: float) -> None:
    rng = np.random.default_rng(int(10 * factor))
    start = Geometry(SCENE.camera.focal_px * factor, np.array([300.0, 600.0]), np.zeros(5), np.zeros(3), np.zeros(3))
    poses = np.hstack([rng.uniform(-3, 3, (8, 3)), rng.uniform([-500, -500, -900], [500, 500, 2000], (8, 3))])
    found = calibrate(start=start, start_poses=poses)
    np.testing.assert_allclose(found.intrinsics.vector, plain.intrinsics.vector, atol=1e-3)
    assert (found.poses[:, 5] > 0).all()


def test_points_that_are_no_numbers_are_listed_and_left_out(plain: CalibratedViews) -> None:
    unseen = int((~SCENE.seen()).sum())
    rule, count = plain.outliers[0].rule, plain.outliers[0].count
    assert unseen > 0
    assert (count, len(plain.points.used)) == (unseen, SCENE.seen().sum())
    assert "finite" in rule
    assert np.isfinite(plain.cov).all()


def test_a_corner_in_glare_is_left_out_by_name() -> None:
    board, image, sigma = arrays()
    image[2][20] += [2.0, -1.0]
    found = calibrated(board, image, SCENE.size, sigmas=sigma)
    assert "view 2, point 20" in found.outliers[-1].places
    assert found.outliers[-1].count <= 3
    assert np.abs(errors(found)).max() < 4


@pytest.mark.medium
def test_a_view_in_the_wrong_order_is_left_out_whole() -> None:
    board, image, sigma = arrays()
    image[3] = np.random.default_rng(2).permutation(image[3])
    found = calibrated(board, image, SCENE.size, sigmas=sigma)
    assert 3 not in found.points.names
    assert any(one.places == ("view 3",) and "median view" in one.rule for one in found.outliers)
    assert np.abs(errors(found)).max() < 4


def test_a_view_twice_counts_once(plain: CalibratedViews) -> None:
    board, image, sigma = arrays()
    found = calibrated(board + board[:2], image + image[:2], SCENE.size, sigmas=sigma + sigma[:2])
    assert found.points.names == plain.points.names
    assert "repeats" in found.notes[0]
    np.testing.assert_allclose(found.cov, plain.cov, rtol=1e-6, atol=1e-12)


def test_points_on_one_line_hold_no_pose() -> None:
    board, image, sigma = arrays()
    row = slice(0, SCENE.spec.columns - 1)
    board[4], image[4], sigma[4] = board[4][row], image[4][row], sigma[4][row]
    found = calibrated(board, image, SCENE.size, sigmas=sigma)
    assert 4 not in found.points.names
    assert "one line" in found.notes[0]


def test_views_of_another_scatter_get_their_own_scale() -> None:
    board, image, sigma = arrays()
    rng = np.random.default_rng(3)
    image[1] = image[1] + 0.8 * rng.standard_normal(image[1].shape)
    found = calibrated(board, image, SCENE.size, sigmas=sigma)
    view, sigma_px = found.points.view, found.points.sigma
    ratio = [np.median(sigma_px[view == k] / sigma_px[view == 0].mean()) for k in (1, 2)]
    assert ratio[0] > 4
    assert 0.5 < ratio[1] < 2
    assert np.abs(errors(found)).max() < 4


@pytest.mark.medium
def test_boards_never_leaned_do_not_tell_the_focal_length() -> None:
    found = calibrate(sight(views=8, lean_rad=0.0, tilt_deg=0.0))
    assert found.status is FitStatus.TOO_FEW_DATA
    assert "Lean the board" in found.notes[-1]
    assert np.isfinite(found.cov).all()


def test_a_prior_holds_what_the_views_do_not_tell() -> None:
    sigma = np.array([15.0, 15.0, 8.0, 8.0, 0.03, 0.02, 1e-3, 1e-3, 0.01])
    mean = np.array([870.0, 870.0, 515.0, 380.0, *VISIBLE_BEND])
    found = calibrate(sight(views=8, lean_rad=0.0, tilt_deg=0.0), prior=Prior.independent(mean, sigma))
    assert found.status is FitStatus.CONVERGED
    assert np.sqrt(found.cov[0, 0]) == pytest.approx(15.0 / np.sqrt(2), rel=0.1)  # fx and fy are as good as one
    assert all(found.free)
    assert "do not determine the whole lens" in " ".join(found.notes)


def test_too_few_views_are_refused_with_the_reason() -> None:
    board, image, _ = arrays()
    image[1] = np.full_like(image[1], np.nan)
    with pytest.raises(FitError, match="View 1 is left out: expected at least 6 points, found 0"):
        calibrated(board[:3], image[:3], SCENE.size)


@settings(
    max_examples=12,
    phases=(Phase.explicit, Phase.generate),
    suppress_health_check=[HealthCheck.too_slow],
)
@given(
    seed=st.integers(0, 10_000),
    tilt=st.floats(0, 60),
    lean=st.floats(0, 0.7),
    noise=st.floats(0.001, 2.0),
    lost=st.floats(0, 0.6),
)
@example(
    seed=193, tilt=3.7937709256791905, lean=0.0, noise=1.678037616289872, lost=0.25196766993552633
)  # an order above that seems to know more
@pytest.mark.medium
def test_whatever_the_views_a_lens_or_advice(seed: int, tilt: float, lean: float, noise: float, lost: float) -> None:
    scene = sight(seed, 8, tilt, lean_rad=lean, sigma_px=noise)
    board, image, sigma = arrays(scene, seed)
    rng = np.random.default_rng(seed)
    image = [np.where(rng.uniform(size=(len(view), 1)) < lost, np.nan, view) for view in image]
    try:
        found = calibrated(board, image, scene.size, sigmas=sigma)
    except FitError:
        # Only where too little was left to begin with.
        assert sum((np.isfinite(view[:, 0]).sum() >= 6) for view in image) < 8
        return
    sigma_of_ray = found.projection_covariance(np.array([[100.0, 100.0]]))
    numbers = (found.intrinsics.vector, found.poses, found.cov, found.residuals_px, sigma_of_ray)
    assert all(np.isfinite(part).all() for part in numbers)
    if found.status is FitStatus.CONVERGED:
        assert np.abs(errors(found, scene)[:2]).max() < 5
    else:
        assert found.notes


def test_the_term_of_arrays_has_the_lens_and_the_sigma_of_its_rays(plain: CalibratedViews) -> None:
    board, image, sigma = arrays()
    found = fit_geometry(board, image, SCENE.size, sigmas=sigma)
    assert found.or_raise() is found
    np.testing.assert_allclose(found.term.distortion, plain.intrinsics.distortion)
    assert [e.name for e in found.estimates] == list(NAMES)
    np.testing.assert_allclose([e.sigma for e in found.estimates], np.sqrt(np.diag(plain.cov)[:9]))
    pixels = np.array([[511.0, 383.0], [40.0, 60.0], [980.0, 700.0]])
    expected = np.sqrt(np.einsum("nii->ni", plain.projection_covariance(pixels)))
    np.testing.assert_allclose(projection_sigma_px(found, pixels), expected, rtol=1e-3)
    assert sum(one.count for one in found.outliers) == sum(one.count for one in plain.outliers)


def test_too_few_arrays_have_a_status_and_arrays_of_other_numbers_an_error() -> None:
    board, image, _ = arrays()
    found = fit_geometry(board[:2], image[:2], SCENE.size)
    assert found.status is FitStatus.TOO_FEW_DATA
    assert "3 views" in found.notes[0]
    found = fit_geometry(board, image, SCENE.size, rules=GeometryRules(least_views=len(board) + 1))
    assert found.status is FitStatus.TOO_FEW_DATA
    assert f"at least {len(board) + 1} views" in found.notes[0]
    with pytest.raises(FitError, match="as many views"):
        fit_geometry(board[:2], image, SCENE.size)


def test_views_need_no_common_corner() -> None:
    board, image, sigma = arrays()
    half = board[0][:, 0] < np.median(board[0][:, 0])
    for view, kept in ((0, half), (1, ~half)):
        image[view][~kept] = np.nan
    found = calibrated(board, image, SCENE.size, sigmas=sigma)
    assert found.status is FitStatus.CONVERGED
    assert np.abs(errors(found)).max() < 4


@pytest.mark.usefixtures("as_other_programs_call")
@pytest.mark.parametrize(
    ("change", "kind"),
    [({"start": "a"}, "Geometry"), ({"prior": {}}, "Prior"), ({"rules": None}, "GeometryRules")],
)
def test_arguments_of_another_kind_are_refused(change: dict[str, Any], kind: str) -> None:
    with pytest.raises(FitError, match=f"Expected a {kind}, found"):
        fit_geometry(*arrays()[:2], SCENE.size, **change)


@pytest.mark.parametrize("pixels", [None, np.zeros(2), np.zeros((1, 3)), [[0.0, 0.0]]])
@pytest.mark.usefixtures("as_other_programs_call")
def test_pixels_are_positions(pixels: Any) -> None:
    lens = Intrinsics.centred(300.0, (320, 240)).camera()
    with pytest.raises(FitError, match="Expected positions as an array of real numbers, n x 2, found"):
        projection_sigma_px(Posterior.from_cov(np.zeros(1), np.eye(1), lambda x: lens), pixels)


@pytest.mark.parametrize("size", [(0, 0), (-320, -240), (320.0, 240.0), (320, 240, 3), None, 320, "320x240"])
def test_a_size_that_no_picture_has_is_refused(size: object) -> None:
    board, image, _ = arrays()
    with pytest.raises(FitError, match="two whole numbers, found"):
        check_picture(size, gather(board, image).points)


def test_rows_and_columns_exchanged_are_refused() -> None:
    board, image, _ = arrays()
    with pytest.raises(FitError, match="Expected corners within the picture"):
        fit_geometry(board, [points[:, ::-1] for points in image], SCENE.size)


@pytest.mark.medium
def test_points_in_the_order_of_another_board_have_no_error_bars() -> None:
    board, image, _ = arrays()
    turned = replace(SCENE.spec, columns=SCENE.spec.rows, rows=SCENE.spec.columns)
    found = fit_geometry([board_points_mm(turned)] * len(board), image, SCENE.size)
    assert not found.usable
    assert "order of the board's" in found.notes[0]


def test_a_pixel_on_which_no_ray_lands_has_no_sigma() -> None:
    found = fit_geometry(*arrays()[:2], SCENE.size)
    with pytest.raises(FitError, match="distortion folds"):
        projection_sigma_px(found, np.array([[1e5, 1e5]]))
    with pytest.raises(FitError, match="Expected a FitResult, found"):
        # Programs do not have the tests' own check of types.
        inspect.unwrap(projection_sigma_px)(found.term, np.array([[160.0, 120.0]]))
    assert np.isfinite(projection_sigma_px(found, np.array([[160.0, 120.0]]))).all()
