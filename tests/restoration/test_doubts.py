"""Exposures that a frame itself makes doubtful: told where it is sure, and silent everywhere else."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from jaxtyping import UInt16

from udccal.io.png import read_rgb8, write_png16
from udccal.profiles.profile import Profile
from udccal.profiles.store import load_profile
from udccal.restoration.doubts import exposure_doubts
from udccal.result import FitStatus

DARKNESS = "where darkness alone gives"


@pytest.fixture(scope="module")
def measured() -> Profile:
    """5.6 e-/s of dark current; 8 s give 45 e-."""
    return load_profile("lg55-reduced")


def frame(profile: Profile, exposure_s: float, darkest_e: float, dark_part: float = 0.25) -> UInt16[np.ndarray, "r c"]:
    """A frame of 2000 e- with a dark corner, its dark signal and its noise."""
    camera, noise = profile.rig.camera, profile.noise.term
    light = np.full((camera.rows, camera.columns), 2000.0)
    light[: round(camera.rows * dark_part)] = darkest_e
    light += float(noise.dark_current_e_per_s) * exposure_s
    rng = np.random.default_rng(5)
    samples = rng.poisson(light) + rng.normal(0.0, float(noise.sigma_d_e), light.shape)
    return np.rint(samples * float(noise.K_DN_per_e) + float(noise.black_DN)).clip(0, 4095).astype(np.uint16)


@pytest.mark.parametrize("exposure_s", [20e-6, 8e-3, 0.1, 1.0, 8.0, 10.0])
@pytest.mark.parametrize("darkest_e", [0.0, 5.0, 500.0])
def test_a_true_exposure_is_not_doubted(measured: Profile, exposure_s: float, darkest_e: float) -> None:
    for dark_part in (0.002, 0.25, 1.0):
        assert exposure_doubts(frame(measured, exposure_s, darkest_e, dark_part), exposure_s, measured) == ()


@pytest.mark.parametrize("said_s", [8.0, 9.9])
def test_milliseconds_are_told_by_dark_places(measured: Profile, said_s: float) -> None:
    (doubt,) = exposure_doubts(frame(measured, 8e-3, 2.0), said_s, measured)
    assert DARKNESS in doubt
    assert "8 ms are 0.008" in doubt


def test_a_frame_without_dark_places_is_not_doubted(measured: Profile) -> None:
    assert exposure_doubts(frame(measured, 8e-3, 100.0), 8.0, measured) == ()


def test_a_colder_camera_and_a_drifting_black_level_are_not_doubted(measured: Profile) -> None:
    """5 degrees less take a third of the dark current away; a code more or less is no darkness."""
    assert exposure_doubts(frame(measured, 8.0 * 0.65, 0.0), 8.0, measured) == ()
    assert exposure_doubts(frame(measured, 1.0, 0.0) - np.uint16(2), 1.0, measured) == ()


def test_what_the_profile_does_not_know_tells_nothing(measured: Profile) -> None:
    nominal = replace(measured, noise=replace(measured.noise, status=FitStatus.NOT_CAPTURED))
    assert exposure_doubts(frame(measured, 8e-3, 0.0), 8.0, nominal) == ()


@pytest.mark.parametrize("said_s", [10.2, 20.0, 1e-6])
def test_an_exposure_that_the_camera_does_not_have_is_told(measured: Profile, said_s: float) -> None:
    doubts = exposure_doubts(frame(measured, 8e-3, 500.0), said_s, measured)
    assert [doubt for doubt in doubts if DARKNESS not in doubt] == [
        f"The rig's camera exposes from 2e-05 s to 10 s, and not for {said_s:g} s. Check that the exposure is in "
        "seconds (8 ms are 0.008)."
    ]


@pytest.mark.medium
def test_the_command_tells_milliseconds_without_a_panel_picture(measured: Profile, tmp_path: Path) -> None:
    write_png16(tmp_path / "frame.png", frame(measured, 8e-3, 2.0))
    said = {}
    for exposure_s in ("8", "0.008"):
        command = [sys.executable, "-m", "udccal.cli.main", "restore", str(tmp_path / "frame.png")]
        command += ["--profile", "lg55-reduced", "--out", str(tmp_path / "out"), "--tier", "preview"]
        done = subprocess.run([*command, "--exposure-s", exposure_s], capture_output=True, text=True, timeout=280)
        assert done.returncode == 0, done.stderr
        said[exposure_s] = " ".join(done.stderr.split())
    assert "frame.png: The frame's darkest places have" in said["8"]
    assert DARKNESS not in said["0.008"]
    assert read_rgb8(tmp_path / "out" / "frame.png").shape == (540, 960, 3)
