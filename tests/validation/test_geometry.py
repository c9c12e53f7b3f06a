"""Corners of boards as their own lens images them, and as a wrong one does."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.profiles.conftest import fitted
from tests.validation.judged import failed, named
from udccal.arrangements import BoardSpec
from udccal.board.charuco import board_points_mm
from udccal.fitting.geometry.bundle import Intrinsics
from udccal.fitting.geometry.corners import BoardCorners
from udccal.fitting.geometry.data import BoardView
from udccal.models.geometry import Geometry
from udccal.result import Diagnostic, FitResult
from udccal.validation.geometry import judge_geometry
from udccal.validation.limits import ValidationLimits

SIZE, SIGMA_PX = (1024, 768), 0.01
SPEC = BoardSpec(12, 9, 50.0, 37.0)


def lens() -> Geometry:
    return Geometry(
        focal_px=np.array([880.0, 880.2]),
        principal_point_px=np.array([506.0, 379.0]),
        distortion=np.array([-0.06, 0.02, 0.0, 0.0, 0.0]),
        rotation_rad=Rotation.from_euler("YXZ", [0.2, -17.0, 0.8], degrees=True).as_rotvec(),
        pupil_mm=np.array([600.0, 190.0, -14.0]),
    )


@pytest.fixture(scope="module")
def result() -> FitResult[Geometry]:
    scatter = (Diagnostic("corner_scatter_on_jig", 0.0, "px"), Diagnostic("corner_scatter_by_hand", 0.0, "px"))
    return replace(fitted("geometry", lens()), diagnostics=scatter)


@pytest.fixture(scope="module")
def views() -> tuple[BoardView, ...]:
    """A board on the jig and six by hand."""
    rng = np.random.default_rng(3)
    panel = Rotation.from_rotvec(lens().rotation_rad).inv()
    leaning = [Rotation.from_euler("xyz", rng.uniform(-25, 25, 3), degrees=True) for _ in range(6)]
    return tuple(_view(rng, turn, number) for number, turn in enumerate((panel, *leaning)))


def _view(rng: np.random.Generator, turn: Rotation, number: int) -> BoardView:
    of, board = lens(), board_points_mm(SPEC)
    matrix = Intrinsics.of_geometry(of).opencv[0]
    away = np.array([*rng.uniform(-80, 80, 2), 800.0]) - turn.apply(board.mean(axis=0))
    seen = cv2.projectPoints(board, turn.as_rotvec(), away, matrix, of.distortion)[0].reshape(-1, 2)
    seen = seen + SIGMA_PX * rng.normal(size=seen.shape)
    corners = BoardCorners(np.arange(len(board)), seen, np.full(len(board), SIGMA_PX))
    return BoardView(f"geometry/view_{number}", SPEC, number == 0, corners, 0.0)


def test_boards_of_the_same_lens_are_predicted(result: FitResult[Geometry], views: tuple[BoardView, ...]) -> None:
    found = judge_geometry(views, result, SIZE, ValidationLimits())
    assert not failed(found)
    assert named(found, "chi-squared").value == pytest.approx(1.0, abs=0.25)
    assert (named(found, "camera's turn").value or 1.0) < 0.01


def test_another_focal_length_fails(result: FitResult[Geometry], views: tuple[BoardView, ...]) -> None:
    wrong = replace(result, term=replace(lens(), focal_px=1.01 * lens().focal_px))
    assert "chi-squared" in failed(judge_geometry(views, wrong, SIZE, ValidationLimits()))


def test_another_distortion_leaves_a_pattern(result: FitResult[Geometry], views: tuple[BoardView, ...]) -> None:
    wrong = replace(result, term=replace(lens(), distortion=np.array([0.04, 0.0, 0.0, 0.0, 0.0])))
    assert {"pattern of the corners", "chi-squared"} <= failed(judge_geometry(views, wrong, SIZE, ValidationLimits()))


def test_a_turned_camera_fails_on_the_jig(result: FitResult[Geometry], views: tuple[BoardView, ...]) -> None:
    turned = Rotation.from_euler("x", 0.2, degrees=True) * Rotation.from_rotvec(lens().rotation_rad)
    wrong = replace(result, term=replace(lens(), rotation_rad=turned.as_rotvec()))
    found = judge_geometry(views, wrong, SIZE, ValidationLimits())
    assert failed(found) == {"camera's turn"}
    assert named(found, "camera's turn").value == pytest.approx(0.2, abs=0.01)


def test_pictures_without_boards_cannot_be_judged(result: FitResult[Geometry], views: tuple[BoardView, ...]) -> None:
    empty = BoardCorners(np.zeros(0, dtype=np.int64), np.zeros((0, 2)), np.zeros(0))
    bare = tuple(replace(view, corners=empty) for view in views)
    assert failed(judge_geometry(bare, result, SIZE, ValidationLimits())) == {"captures"}


def scattered(view: BoardView, by_px: float) -> BoardView:
    """The view with corners that lie where no pose of its board puts them."""
    noise = by_px * np.random.default_rng(7).normal(size=view.corners.xy.shape)
    return replace(view, corners=replace(view.corners, xy=view.corners.xy + noise))


@pytest.mark.parametrize("by_px", [0.3, 1.2, 1.5, 2.0, 3.0, 5.0, 20.0])
def test_one_strange_view_fails_by_name_and_the_others_are_judged(
    result: FitResult[Geometry], views: tuple[BoardView, ...], by_px: float
) -> None:
    found = judge_geometry((*views[:4], scattered(views[4], by_px), *views[5:]), result, SIZE, ValidationLimits())
    assert failed(found) == {"strange views"}
    assert named(found, "strange views").value == 1
    assert "In geometry/view_4," in named(found, "strange views").what
    assert named(found, "chi-squared").value == pytest.approx(1.0, abs=0.25)


def test_a_strange_jig_says_nothing_of_the_cameras_turn(
    result: FitResult[Geometry], views: tuple[BoardView, ...]
) -> None:
    found = judge_geometry((scattered(views[0], 5.0), *views[1:]), result, SIZE, ValidationLimits())
    assert failed(found) == {"strange views"}
    assert "camera's turn" not in {check.name for check in found.checks}


def few(view: BoardView, ids: np.ndarray) -> BoardView:
    corners = view.corners
    return replace(view, corners=BoardCorners(corners.ids[ids], corners.xy[ids], corners.sigma[ids]))


def test_corners_on_one_line_cannot_be_judged(result: FitResult[Geometry], views: tuple[BoardView, ...]) -> None:
    line = few(views[1], np.arange(8))
    found = judge_geometry([line], result, SIZE, ValidationLimits())
    assert failed(found) == {"captures"}
    assert "two rows of corners" in named(found, "captures").what
    assert not failed(judge_geometry([line, *views], result, SIZE, ValidationLimits()))


def test_a_strange_view_alone_cannot_be_judged(result: FitResult[Geometry], views: tuple[BoardView, ...]) -> None:
    six = few(views[1], np.array([1, 3, 32, 67, 72, 83]))
    six.corners.xy[4] += [3.0, 1.0]  # left out; the five others are too few to test a pose
    found = judge_geometry([six], result, SIZE, ValidationLimits())
    assert failed(found) == {"captures"}
    assert "In geometry/view_1," in named(found, "captures").what
