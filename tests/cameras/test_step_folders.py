from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from procedures.base import Stage
from tests.cameras.backends import picture
from tests.cameras.small_tiff import Shot, write_dng
from udccal.arrangements import Dark, FlatLight, Occasion
from udccal.cameras.protocol import Settings
from udccal.cameras.step_folders import StepFolders
from udccal.errors import CameraError
from udccal.io.png import write_png16


@pytest.fixture
def root(tmp_path: Path) -> Path:
    for step, seeds in (("wire/flat", (0, 1, 2)), ("wire/dark", (3,))):
        folder = tmp_path / step
        folder.mkdir(parents=True)
        for seed in seeds:
            write_dng(folder / f"{seed}.dng", picture(48, 64, seed), Shot((1, 100)))
    (tmp_path / "noise" / "flat_0").mkdir(parents=True)
    return tmp_path


def occasion(step_id: str) -> Occasion:
    return Occasion(step_id, 0, "Cap the lens.")


def test_each_step_has_the_files_of_its_folder(root: Path) -> None:
    stage = StepFolders(root)
    assert isinstance(stage, Stage)
    with stage.camera as camera:
        for step, arrangement, seeds in (("wire/flat", FlatLight(), (0, 1, 2)), ("wire/dark", Dark(), (3,))):
            stage.arrange(arrangement, occasion(step))
            accepted = camera.configure(Settings(1e-3, 0.0, camera.sensor))
            assert accepted.exposure_s == 0.01
            frames = list(camera.frames(len(seeds)))
            for frame, seed in zip(frames, seeds, strict=True):
                np.testing.assert_array_equal(frame.data, picture(48, 64, seed))


def test_the_same_folders_are_the_same_camera(root: Path) -> None:
    assert StepFolders(root).camera.identity == StepFolders(root).camera.identity
    assert StepFolders(root).camera.identity.serial == "0042"


@pytest.mark.parametrize("step", ["noise/flat_0", "psf/p00_s0"])
def test_a_step_without_pictures_is_named(step: str, root: Path) -> None:
    stage = StepFolders(root)
    with stage.camera, pytest.raises(CameraError, match=rf"step {step} in .*found none\. Cap the lens\. Put the files"):
        stage.arrange(Dark(), occasion(step))


def test_another_cameras_step_is_refused(root: Path) -> None:
    write_dng(root / "noise" / "flat_0" / "0.dng", picture(48, 64), Shot((1, 100), serial="9"))
    with pytest.raises(CameraError, match="files of one camera"):
        stage_at(root, "wire/flat", "noise/flat_0")


def stage_at(root: Path, *steps: str) -> None:
    stage = StepFolders(root)
    with stage.camera:
        for step in steps:
            stage.arrange(Dark(), occasion(step))


def test_files_must_say_their_exposure(tmp_path: Path) -> None:
    folder = tmp_path / "wire" / "flat"
    folder.mkdir(parents=True)
    write_png16(folder / "a.png", picture(12, 16))
    with pytest.raises(CameraError, match=r"a frames\.csv in its folder, found neither"):
        StepFolders(tmp_path, bits=12)
    (folder / "frames.csv").write_text("file,exposure_s\na.png,0.25\n")
    with StepFolders(tmp_path, bits=12).camera as camera:
        assert next(camera.frames(1)).settings.exposure_s == 0.25


def test_no_folders_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.png").touch()
    with pytest.raises(CameraError, match=r"such as .*wire/flat, found none"):
        StepFolders(tmp_path)
