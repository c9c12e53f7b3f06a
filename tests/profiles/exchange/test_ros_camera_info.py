"""ROS's file has the fields of camera_calibration_parsers, in YAML that any reader takes."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tests.profiles.exchange.conftest import LENS
from udccal.models.geometry import project
from udccal.numerics import in_float64
from udccal.profiles.exchange.exports import EXPORTS
from udccal.profiles.exchange.imports import IMPORTS, read_lens
from udccal.profiles.exchange.plain_yaml import Document, read_yaml
from udccal.profiles.profile import Profile

# Of parse_yml.cpp, in the order in which it writes them; matrices with their sizes.
FIELDS: dict[str, tuple[int, int] | type] = {
    "image_width": int,
    "image_height": int,
    "camera_name": str,
    "camera_matrix": (3, 3),
    "distortion_model": str,
    "distortion_coefficients": (1, 5),
    "rectification_matrix": (3, 3),
    "projection_matrix": (3, 4),
}
# As camera_calibration writes it: data over several lines, numbers without digits after the point.
CALIBRATOR = """image_width: 96
image_height: 64
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [80.5,  0. , 46.25,
          0. , 81. , 30.5,
          0. ,  0. ,  1. ]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.1, 0.02, 1e-4, -2e-05, 0.]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1., 0., 0.,
         0., 1., 0.,
         0., 0., 1.]
projection_matrix:
  rows: 3
  cols: 4
  data: [79., 0., 46., 0.,
         0., 80., 30., 0.,
         0., 0., 1., 0.]
"""


def check_schema(found: dict[str, Any]) -> None:
    assert list(found) == list(FIELDS)
    for name, kind in FIELDS.items():
        if isinstance(kind, type):
            assert type(found[name]) is kind, name
        else:
            assert list(found[name]) == ["rows", "cols", "data"], name
            assert (found[name]["rows"], found[name]["cols"], len(found[name]["data"])) == (*kind, kind[0] * kind[1])


def read_by_pyyaml(text: bytes) -> dict[str, Any]:
    code = "import json, sys, yaml; print(json.dumps(yaml.safe_load(sys.stdin), sort_keys=False))"
    done = subprocess.run(["/usr/bin/python3", "-c", code], input=text, capture_output=True)
    if done.returncode:
        pytest.skip("needs PyYAML in the system's Python (Debian's python3-yaml)")
    return dict(json.loads(done.stdout))


def test_another_reader_finds_the_schema_and_the_same_lens(profile: Profile, points: np.ndarray) -> None:
    found = read_by_pyyaml(EXPORTS["ros-camera-info"].encode(profile))
    check_schema(found)
    matrix = np.array(found["camera_matrix"]["data"]).reshape(3, 3)
    theirs = cv2.projectPoints(
        points, np.zeros(3), np.zeros(3), matrix, np.array(found["distortion_coefficients"]["data"])
    )[0].reshape(-1, 2)
    ours = in_float64(lambda: np.asarray(project(LENS, points)))()
    assert np.abs(theirs - ours).max() < 1e-9
    projection = np.array(found["projection_matrix"]["data"]).reshape(3, 4)
    np.testing.assert_array_equal(projection, np.column_stack([matrix, np.zeros(3)]))
    with pytest.raises(AssertionError):
        check_schema({**found, "distortion_coeffs": found["distortion_coefficients"]})


def test_our_reader_finds_the_schema(profile: Profile) -> None:
    document = read_yaml(EXPORTS["ros-camera-info"].encode(profile).decode(), "f")
    assert list(document.entries) == list(FIELDS)
    assert all(isinstance(document.entries[name], Document) for name, kind in FIELDS.items() if isinstance(kind, tuple))


def test_what_the_calibrator_writes_is_read(tmp_path: Path) -> None:
    for text in (CALIBRATOR, CALIBRATOR.replace("distortion_model: plumb_bob\n", ""), CALIBRATOR + "\n...\n"):
        (tmp_path / "camera.yaml").write_text(text)
        lens = read_lens(tmp_path / "camera.yaml", IMPORTS["ros-camera-info"])
        np.testing.assert_array_equal(lens.focal_px, [80.5, 81.0])
        np.testing.assert_array_equal(lens.principal_point_px, [46.25, 30.5])
        np.testing.assert_array_equal(lens.distortion, [-0.1, 0.02, 1e-4, -2e-5, 0.0])


def test_a_rational_lens_is_read_where_it_is_none(tmp_path: Path) -> None:
    eight = CALIBRATOR.replace("plumb_bob", "rational_polynomial").replace("cols: 5", "cols: 8")
    (tmp_path / "camera.yaml").write_text(eight.replace("-2e-05, 0.]", "-2e-05, 0.3, 0, 0., -0.0]"))
    lens = read_lens(tmp_path / "camera.yaml", IMPORTS["ros-camera-info"])
    np.testing.assert_array_equal(lens.distortion, [-0.1, 0.02, 1e-4, -2e-5, 0.3])
