"""OpenCV reads the file, and projects as udccal does."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.profiles.exchange.conftest import LENS
from udccal.errors import ProfileError
from udccal.models.geometry import project
from udccal.numerics import in_float64
from udccal.profiles.exchange.exports import EXPORTS, covariance_file, export_profile
from udccal.profiles.exchange.imports import IMPORTS, read_lens
from udccal.profiles.profile import Profile

FORMAT = EXPORTS["opencv-yaml"]
PX = 1e-9


@pytest.fixture
def file(tmp_path: Path, profile: Profile) -> Path:
    export_profile(profile, FORMAT, tmp_path / "lens.yaml")
    return tmp_path / "lens.yaml"


def ours(points: np.ndarray) -> np.ndarray:
    return in_float64(lambda: np.asarray(project(LENS, points)))()


def test_opencv_projects_as_udccal_does(file: Path, points: np.ndarray) -> None:
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_READ)
    matrix, distortion = (storage.getNode(name).mat() for name in ("camera_matrix", "distortion_coefficients"))
    assert (storage.getNode("image_width").real(), storage.getNode("image_height").real()) == (96, 64)
    theirs = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, distortion)[0].reshape(-1, 2)
    assert np.abs(theirs - ours(points)).max() < PX
    # The check tells: with k3 where p1 belongs, and with pixels counted from their corner, it is not so.
    for wrong in (distortion[[0, 1, 4, 3, 2]], distortion + np.eye(5)[:, :1] * 1e-9):
        theirs = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, wrong)[0].reshape(-1, 2)
        assert np.abs(theirs - ours(points)).max() > 10 * PX


def test_opencv_finds_the_camera_behind_the_panel(file: Path) -> None:
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_READ)
    rotation, pupil = storage.getNode("R_panel_camera").mat(), storage.getNode("pupil_mm").mat()
    np.testing.assert_allclose(cv2.Rodrigues(rotation)[0][:, 0], LENS.rotation_rad, atol=1e-12)
    np.testing.assert_array_equal(pupil[:, 0], LENS.pupil_mm)


def test_it_comes_back_to_the_bit(file: Path) -> None:
    lens = read_lens(file, IMPORTS["opencv-yaml"])
    for name in ("focal_px", "principal_point_px", "distortion"):
        np.testing.assert_array_equal(getattr(lens, name), getattr(LENS, name))
    assert (lens.columns, lens.rows) == (96, 64)
    assert lens.pose is not None
    np.testing.assert_allclose(cv2.Rodrigues(lens.pose.R_panel_camera)[0][:, 0], LENS.rotation_rad, atol=1e-12)


def test_what_opencv_writes_is_read(tmp_path: Path) -> None:
    path = tmp_path / "theirs.yml"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("calibration_time", "Mon 23 Nov 2026 # at noon: sharp")
    storage.write("image_width", 96)
    storage.write("image_height", 64)
    storage.write("avg_reprojection_error", 0.3)
    storage.writeComment("a set of 5 coefficients")
    storage.write("camera_matrix", np.array([[80.5, 0, 46.25], [0, 81.0, 1 / 3], [0, 0, 1]]))
    storage.write("distortion_coefficients", np.array([[-0.1, 0.02, 1e-4, -2e-5]]))
    storage.write("image_points", np.zeros((3, 4, 2), np.float32))
    storage.release()
    lens = read_lens(path, IMPORTS["opencv-yaml"])
    np.testing.assert_array_equal(lens.focal_px, [80.5, 81.0])
    np.testing.assert_array_equal(lens.principal_point_px, [46.25, 1 / 3])
    np.testing.assert_array_equal(lens.distortion, [-0.1, 0.02, 1e-4, -2e-5, 0.0])
    assert lens.pose is None


@pytest.mark.parametrize(("entry", "fisheye"), [("0", False), ("1", True)])
def test_the_coefficients_of_a_fisheye_are_not_taken_for_others(file: Path, entry: str, fisheye: bool) -> None:
    file.write_text(file.read_text().replace("---\n", f"---\nfisheye_model: {entry}\n"))
    if not fisheye:
        assert read_lens(file, IMPORTS[FORMAT.name]).columns == 96
        return
    with pytest.raises(ProfileError, match="found its fisheye model"):
        read_lens(file, IMPORTS[FORMAT.name])


def test_the_covariance_is_beside_it(file: Path) -> None:
    assert covariance_file(file).name == "lens.yaml.json"
    assert '"term": "geometry"' in covariance_file(file).read_text()
