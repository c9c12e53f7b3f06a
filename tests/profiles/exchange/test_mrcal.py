"""Debian's mrcal reads the model, projects as udccal does, and differs two models by as much as ``udccal.diff``."""

from __future__ import annotations

import dataclasses
import functools
import json
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.profiles.conftest import fitted
from tests.profiles.exchange.conftest import LENS
from udccal.comparison.maps import _rays
from udccal.models.geometry import Geometry, project, project_directions
from udccal.numerics import in_float64
from udccal.profiles.exchange.exports import EXPORTS, export_profile
from udccal.profiles.exchange.imports import IMPORTS, read_lens
from udccal.profiles.profile import Profile

PYTHON = "/usr/bin/python3"
READ = """
import json, sys
import numpy as np
import mrcal
given = json.load(sys.stdin)
models = [mrcal.cameramodel(path) for path in given["files"]]
def differences(radius):
    return mrcal.projection_diff(models, gridn_width=25, gridn_height=19, use_uncertainties=False, distance=None,
                                 focus_radius=radius)[1].reshape(-1, 2).tolist()
answer = {"size": models[0].imagersize().tolist(), "model": models[0].intrinsics()[0]}
answer["pixels"] = mrcal.project(np.array(given["points"]), *models[0].intrinsics()).tolist()
panel = models[0].extrinsics_Rt_fromref()
answer["from_panel"] = mrcal.project(
    mrcal.transform_point_Rt(panel, np.array(given["panel_m"])), *models[0].intrinsics()
).tolist()
if len(models) == 2:
    answer["rays"] = differences(0)          # by the poses in the files
    answer["lens"] = differences(1e6)        # after the turn that fits best over the whole picture
print(json.dumps(answer))
"""


@functools.cache
def _there() -> bool:
    return Path(PYTHON).exists() and subprocess.run([PYTHON, "-c", "import mrcal"], capture_output=True).returncode == 0


needs_mrcal = pytest.mark.skipif("not _there()", reason="needs Debian's package python3-mrcal")


def mrcal_reads(*files: Path, points: np.ndarray, panel_m: np.ndarray) -> dict[str, Any]:
    given = {"files": [str(file) for file in files], "points": points.tolist(), "panel_m": panel_m.tolist()}
    done = subprocess.run([PYTHON, "-c", READ], input=json.dumps(given), capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return dict(json.loads(done.stdout))


def write(profile: Profile, path: Path) -> Path:
    export_profile(profile, EXPORTS["mrcal"], path)
    return path


def test_a_file_says_that_its_pose_is_not_read_back(tmp_path: Path, profile: Profile) -> None:
    assert any("does not read the pose back" in sentence for sentence in EXPORTS["mrcal"].not_held)
    assert read_lens(write(profile, tmp_path / "a.cameramodel"), IMPORTS["mrcal"]).pose is None


def panel_points_m() -> np.ndarray:
    """Points up to two metres before the panel, in its frame."""
    x, y = np.meshgrid(np.linspace(0.2, 1.0, 5), np.linspace(-0.5, 0.6, 5))
    return np.column_stack([x.ravel(), y.ravel(), np.linspace(1.0, 2.0, x.size)])


@needs_mrcal
def test_mrcal_projects_as_udccal_does(tmp_path: Path, profile: Profile, points: np.ndarray) -> None:
    panel_m = panel_points_m()
    answer = mrcal_reads(write(profile, tmp_path / "a.cameramodel"), points=points, panel_m=panel_m)
    assert (answer["size"], answer["model"]) == ([96, 64], "LENSMODEL_OPENCV5")
    ours = in_float64(lambda: np.asarray(project(LENS, points)))()
    assert np.abs(np.array(answer["pixels"]) - ours).max() < 1e-9
    seen = in_float64(lambda: np.asarray(project_directions(LENS, panel_m * 1000 - LENS.pupil_mm)))()
    assert np.abs(np.array(answer["from_panel"]) - seen).max() < 1e-9


@needs_mrcal
def test_mrcal_tells_the_difference_that_udccal_tells(tmp_path: Path, profile: Profile, points: np.ndarray) -> None:
    other = Geometry(
        LENS.focal_px * 1.0005,
        LENS.principal_point_px + np.array([0.02, -0.03]),
        LENS.distortion + np.array([2e-3, -1e-3, 2e-4, 1e-4, 5e-4]),
        LENS.rotation_rad + np.array([1e-4, -2e-4, 3e-4]),
        LENS.pupil_mm,
    )
    changed = dataclasses.replace(profile, geometry=fitted("geometry", other))
    files = write(profile, tmp_path / "a.cameramodel"), write(changed, tmp_path / "b.cameramodel")
    answer = mrcal_reads(*files, points=points, panel_m=panel_points_m())
    rays, lens, _ = _rays(profile, changed)
    for ours, theirs in ((rays, answer["rays"]), (lens, answer["lens"])):
        size = np.percentile(np.hypot(*ours.T), 95)
        assert size > 0.01
        assert abs(np.percentile(np.hypot(*np.transpose(theirs)), 95) - size) < 0.01 * size
        # Place by place, not only in sum.
        assert np.abs(ours - np.array(theirs)).max() < 0.01 * np.hypot(*ours.T).max()


def test_the_lenses_differ_by_as_much_the_other_way_round(profile: Profile) -> None:
    """By 20 px here: what is 1 % of the focal length to one profile is not quite that to the other."""
    other = dataclasses.replace(LENS, focal_px=LENS.focal_px * 1.01, distortion=LENS.distortion * 2 + 0.01)
    changed = dataclasses.replace(profile, geometry=fitted("geometry", other))
    there, back = _rays(profile, changed)[1], _rays(changed, profile)[1]
    assert np.abs(there).max() > 0.1
    assert np.abs(there + back).max() < 1e-6 * np.abs(there).max()


def test_it_comes_back_to_the_bit(tmp_path: Path, profile: Profile) -> None:
    lens = read_lens(write(profile, tmp_path / "a.cameramodel"), IMPORTS["mrcal"])
    for name in ("focal_px", "principal_point_px", "distortion"):
        np.testing.assert_array_equal(getattr(lens, name), getattr(LENS, name))
    assert (lens.columns, lens.rows) == (96, 64)


@pytest.mark.parametrize(
    "more", ["", "    'optimization_inputs': b'P)h>@6aWAK2mnY{22B0=#{k}~|',\n    'icam_intrinsics': 0,\n"]
)
def test_what_mrcal_writes_is_read(tmp_path: Path, more: str) -> None:
    text = """# generated by mrcal-calibrate-cameras, which isn't a "tool" of ours
{
    'lensmodel':  'LENSMODEL_OPENCV8',

    # intrinsics are fx,fy,cx,cy,distortion0,distortion1,....
    'intrinsics': [ 880, 881.5, 506, 379, -0.06, 0.02, -0.0003, -1e-05, -0.004, 0, 0, 0,],

    'valid_intrinsics_region': [
    [ 1, 2 ],
    [ 3, 4 ],
],

    # extrinsics are rt_fromref
    'extrinsics': [ 0.3, 0.1, 0.2, 1, 2, 3,],

    'imagersize': [ 1024, 768,],

"""
    (tmp_path / "m.cameramodel").write_text(f"{text}{more}}}\n")
    lens = read_lens(tmp_path / "m.cameramodel", IMPORTS["mrcal"])
    np.testing.assert_array_equal(lens.focal_px, [880.0, 881.5])
    np.testing.assert_array_equal(lens.distortion, [-0.06, 0.02, -0.0003, -1e-05, -0.004])
    assert (lens.columns, lens.rows, lens.pose) == (1024, 768, None)
