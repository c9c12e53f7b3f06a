"""An imported lens makes a whole profile; what cannot be read is refused in a sentence."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.profiles.exchange.conftest import LENS
from tests.profiles.exchange.test_ros_camera_info import CALIBRATOR
from tests.profiles.test_store import assert_same
from udccal.cli.jobs.show import show_profile
from udccal.cli.output import Output
from udccal.cli.profile import ExportTo, ImportFrom
from udccal.errors import ProfileError
from udccal.fitting.nominal import nominal_geometry
from udccal.profiles.exchange.exports import EXPORTS, export_profile
from udccal.profiles.exchange.imports import IMPORTS, MOST_BYTES, profile_of, read_lens
from udccal.profiles.exchange.lens import Pose, lens_of
from udccal.profiles.exchange.usable import check_usable
from udccal.profiles.profile import Profile
from udccal.profiles.store import read_profile, write_profile
from udccal.reports.true_values import true_geometry
from udccal.rig import RigDescription, load_rig
from udccal.rig_folders import rig_names, shipped_rig_folder
from udccal.simulation.truth import draw_truth


def test_the_command_offers_what_there_is() -> None:
    assert [one.value for one in ExportTo] == list(EXPORTS)
    assert [one.value for one in ImportFrom] == list(IMPORTS)


@pytest.mark.medium
def test_a_lens_becomes_a_whole_profile(tmp_path: Path, toy_rig: RigDescription) -> None:
    (tmp_path / "camera.yaml").write_text(CALIBRATOR)
    made = profile_of(read_lens(tmp_path / "camera.yaml", IMPORTS["ros-camera-info"]), toy_rig, "camera.yaml")
    assert [result.status.name for result in made.results] == ["NOT_CAPTURED", "IMPORTED", *["NOT_CAPTURED"] * 3]
    assert "nominal" in made.geometry.notes[0]
    np.testing.assert_array_equal(made.wire.term.geometry.focal_px, [80.5, 81.0])
    assert np.all(made.wire_map == 1.0)
    write_profile(tmp_path / "p", made)
    assert_same(read_profile(tmp_path / "p"), made)
    assert not made.warnings


@pytest.mark.medium
def test_an_imported_lens_is_shown(tmp_path: Path, toy_rig: RigDescription, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "camera.yaml").write_text(CALIBRATOR)
    made = profile_of(read_lens(tmp_path / "camera.yaml", IMPORTS["ros-camera-info"]), toy_rig, "camera.yaml")
    write_profile(tmp_path / "p", made)
    show_profile(Output(), tmp_path / "p")
    said = " ".join("".join(capsys.readouterr()).replace("│", " ").split())
    assert "Imported from camera.yaml" in said
    for number in ("focal length, x 80.5 px fx", "focal length, y 81 px fy", "distortion, radial 3"):
        assert number in said
    # Nothing was fitted.
    assert "fit used" not in said


def test_the_pose_is_taken_where_it_is_udccals(tmp_path: Path, profile: Profile) -> None:
    found = {}
    for name, to in EXPORTS.items():
        if name in IMPORTS:
            export_profile(profile, to, tmp_path / name)
            made = profile_of(read_lens(tmp_path / name, IMPORTS[name]), profile.rig, name)
            found[name] = np.abs(np.asarray(made.geometry.term.rotation_rad) - LENS.rotation_rad).max() < 1e-12
    assert found == {"opencv-yaml": True, "ros-camera-info": False, "mrcal": False}


def test_a_lens_of_another_sensor_is_refused(profile: Profile) -> None:
    other = dataclasses.replace(lens_of(profile), columns=97)
    with pytest.raises(ProfileError, match="found one for 97 x 64 px"):
        profile_of(other, profile.rig, "f")
    wild = dataclasses.replace(lens_of(profile), focal_px=np.array([1e7, 80.0]))
    with pytest.raises(ProfileError, match=r"'geometry\.focal_px' to be from 1 to 1e\+06, .*\. Correct it in f\.$"):
        profile_of(wild, profile.rig, "f")


UNUSABLE: dict[str, tuple[dict[str, object], str]] = {
    "a camera that looks away": (
        {"pose": Pose(np.diag([-1.0, 1.0, -1.0]), np.array([9.0, 9.0, -14.0]))},
        "R_panel_camera",
    ),
    "a camera that looks along the panel": (
        {"pose": Pose(np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]), np.array([9.0, 9.0, -14.0]))},
        "R_panel_camera",
    ),
    "a camera before the panel": ({"pose": Pose(np.eye(3), np.array([9.0, 9.0, 14.0]))}, "pupil_mm"),
    "a camera in the panel": ({"pose": Pose(np.eye(3), np.zeros(3))}, "pupil_mm"),
    "a folded picture": ({"distortion": np.array([-0.75, 0.0, 0.0, 0.0, 0.0])}, "distortion_coefficients"),
    "a picture that folds at its corners": (
        {"distortion": np.array([-0.9, 0.4, 0.0, 0.0, 0.0])},
        "distortion_coefficients",
    ),
    "a principal point far off": ({"principal_point_px": np.array([9e4, 30.0])}, "camera_matrix"),
    "a focal length of a pixel": ({"focal_px": np.array([1.0, 80.0])}, "camera_matrix"),
    "a picture that looks back from the nominal pose": (
        {"principal_point_px": np.array([46.0, -366.0]), "distortion": np.zeros(5), "pose": None},
        "camera_matrix",
    ),
}


@pytest.mark.parametrize("fault", UNUSABLE)
def test_a_lens_that_nothing_can_be_restored_with_is_refused(profile: Profile, fault: str) -> None:
    changes, entry = UNUSABLE[fault]
    with pytest.raises(ProfileError, match=rf"'{entry}'.* in camera\.yaml ") as refused:
        profile_of(dataclasses.replace(lens_of(profile), **changes), profile.rig, "camera.yaml (opencv-yaml)")
    assert "found" in str(refused.value)


@pytest.mark.parametrize("name", rig_names(shipped_rig_folder()))
def test_lenses_of_shipped_rigs_and_stronger_ones_are_usable(name: str) -> None:
    rig = load_rig(name)
    true = [true_geometry(draw_truth(rig, seed)) for seed in (0, 1)]
    stronger = [np.array([k1, -0.2 * k1, 1e-3, -1e-3, 0.0]) for k1 in (-0.3, 0.3)]
    for geometry in (*true, *(dataclasses.replace(nominal_geometry(rig), distortion=each) for each in stronger)):
        check_usable(geometry, True, rig, "f")


MODEL = "{'lensmodel': 'LENSMODEL_OPENCV5', 'intrinsics': [80, 81, 46, 30, .1, .2, .3, .4, .5], 'imagersize': [96, 64]}"


def ros(old: str, new: str) -> tuple[str, str]:
    assert CALIBRATOR.count(old) >= 1
    return "ros-camera-info", CALIBRATOR.replace(old, new, 1)


def mrcal(old: str, new: str) -> tuple[str, str]:
    assert MODEL.count(old) == 1
    return "mrcal", MODEL.replace(old, new)


BROKEN: dict[str, tuple[tuple[str, str], str]] = {
    "an empty file": (("ros-camera-info", ""), "'image_width'"),
    "another text": (("opencv-yaml", "Dear all,\nwe met today."), "plain YAML"),
    "a size that is no number": (ros("image_width: 96", "image_width: many"), "a whole number, found many"),
    "a size of nothing": (ros("image_width: 96", "image_width: 0"), "1 to 16384 px"),
    "a size beyond 2^14": (ros("image_width: 96", "image_width: 16385"), "1 to 16384 px"),
    "a size of 2^31": (ros("image_width: 96", "image_width: 2147483648"), "a whole number"),
    "not a number": (ros("80.5", ".nan"), "finite numbers, found .nan"),
    "infinity": (ros("80.5", "1e999"), "finite numbers, found 1e999"),
    "a long number": (ros("80.5", "9" * 5000), "finite numbers, found 9999"),
    "a word for a matrix": (ros("camera_matrix:\n  rows: 3\n  cols: 3\n", "camera_matrix: 3\n"), "plain YAML"),
    "a matrix of another size": (ros("cols: 4", "cols: 3"), "3 x 3 numbers"),
    "a matrix that claims 2^20 rows": (ros("rows: 3", "rows: 1048576"), "1048576 x 3 numbers"),
    "too few numbers": (ros("79., 0., 46., 0.,", "79., 0., 46.,"), "3 x 4 numbers"),
    "a skew": (ros("80.5,  0. ", "80.5,  2. "), "no skew"),
    "another distortion": (ros("plumb_bob", "equidistant"), "'equidistant'"),
    "a rational lens": (
        ros("cols: 5\n  data: [-0.1, 0.02, 1e-4, -2e-05, 0.]", "cols: 6\n  data: [-0.1, 0.02, 0, 0, 0.1, 0.3]"),
        "further ones are not 0",
    ),
    "three coefficients": (
        ros("cols: 5\n  data: [-0.1, 0.02, 1e-4, -2e-05, 0.]", "cols: 3\n  data: [-0.1, 0.02, 1e-4]"),
        "0, 4, 5, 8, 12, 14 coefficients in .* found 3",
    ),
    "a name twice": (ros("camera_name:", "image_width:"), "found 'image_width"),
    "a reference": (ros("narrow_stereo", "*anchor"), r"'\*anchor'"),
    "an object to build": (ros("narrow_stereo", "!!python/object/apply:os.system [date]"), "plain YAML"),
    "a list in a list": (ros("[79.", "[[79."), "plain YAML"),
    "a list without end": (ros("0., 0., 1., 0.]", "0., 0., 1., 0."), "plain YAML"),
    "deep nesting": (("opencv-yaml", "".join(f"{' ' * n}a:\n" for n in range(20))), "plain YAML"),
    "another literal": (("mrcal", "[1, 2]"), "another value"),
    "a call": (("mrcal", "__import__('os').system('date')"), "another text"),
    "a call in a value": (mrcal("[96, 64]", "print(1)"), "another text"),
    "deep brackets": (("mrcal", "[" * 50000 + "]" * 50000), "another text"),
    "many signs": (("mrcal", "{'intrinsics': " + "-" * 50000 + "1}"), "another text"),
    "many numbers": (mrcal("[96, 64]", "[" + "1," * 10_000_000 + "]"), "another text|at most"),
    "half a model": (("mrcal", MODEL[:60]), "camera model of mrcal"),
    "a splined lens": (
        mrcal("LENSMODEL_OPENCV5", "LENSMODEL_SPLINED_STEREOGRAPHIC_order=3"),
        "mrcal-convert-lensmodel",
    ),
    "a model to come": (mrcal("LENSMODEL_OPENCV5", "LENSMODEL_OPENCV14"), "mrcal-convert-lensmodel"),
    "too few intrinsics": (mrcal(", .5]", "]"), "9 finite numbers"),
    "a word among the intrinsics": (mrcal("[80,", "['80',"), "9 finite numbers"),
    "infinite intrinsics": (mrcal("[80,", "[1e999,"), "9 finite numbers"),
    "a long intrinsic": (mrcal("[80,", f"[{'9' * 5000},"), "camera model of mrcal|9 finite numbers"),
    "half a pixel": (mrcal("[96, 64]", "[96.5, 64]"), "whole numbers"),
    "no size": (mrcal(", 'imagersize': [96, 64]", ""), "2 finite numbers as 'imagersize'"),
    "an unhashable key": (("mrcal", "{[1]: 2}"), "camera model of mrcal"),
    "a complex number": (mrcal("[80,", "[80e0 - 1,"), "camera model of mrcal|9 finite numbers"),
}


@pytest.mark.parametrize("fault", BROKEN)
def test_what_is_wrong_with_a_file_is_a_sentence(tmp_path: Path, fault: str) -> None:
    (name, text), words = BROKEN[fault]
    (tmp_path / "f").write_text(text)
    with pytest.raises(ProfileError, match=words) as refused:
        read_lens(tmp_path / "f", IMPORTS[name])
    sentence = str(refused.value)
    assert sentence.startswith("Expected ")
    assert "found" in sentence
    assert len(sentence) < 400 + len(str(tmp_path))


@pytest.mark.parametrize(
    ("write", "words"),
    [
        (lambda path: path.mkdir(), "found none"),
        (lambda path: path.write_bytes(b"\xff\xfe\x00"), "to be text"),
        (lambda path: path.write_bytes(bytes(MOST_BYTES + 1)), "at most 8388608 bytes"),
        (lambda path: None, "found none"),
    ],
)
def test_what_is_no_text_is_refused(tmp_path: Path, write: Callable[[Path], object], words: str) -> None:
    write(tmp_path / "f")
    with pytest.raises(ProfileError, match=words):
        read_lens(tmp_path / "f", IMPORTS["mrcal"])


def test_the_whole_models_are_read(tmp_path: Path) -> None:
    for name, text in (("mrcal", MODEL), ("ros-camera-info", CALIBRATOR)):
        (tmp_path / "f").write_text(text)
        assert read_lens(tmp_path / "f", IMPORTS[name]).columns == 96


def test_the_mark_that_some_editors_begin_a_text_with_is_passed_over(tmp_path: Path) -> None:
    for name, text in (("mrcal", MODEL), ("ros-camera-info", CALIBRATOR)):
        (tmp_path / "f").write_text(text, encoding="utf-8-sig")
        assert read_lens(tmp_path / "f", IMPORTS[name]).columns == 96


def test_a_file_whose_name_is_no_text_can_be_imported(tmp_path: Path, profile: Profile) -> None:
    made = profile_of(lens_of(profile), profile.rig, "linse\udcff.yaml")
    write_profile(tmp_path / "p", made)
    assert "linse?.yaml" in read_profile(tmp_path / "p").geometry.notes[0]
