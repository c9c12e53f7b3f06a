"""Every example runs, at toy size."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.toy_rigs import write_toy_rig
from udccal.io.exr import write_rgb_exr
from udccal.io.png import read_rgb8, write_rgb8
from udccal.profiles.store import load_profile

ROOT = Path(__file__).resolve().parents[2]


def run(*words: str | Path) -> str:
    done = subprocess.run([sys.executable, *map(str, words)], capture_output=True, text=True, timeout=1000, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def toy_rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_toy_rig(tmp_path_factory.mktemp("rig"))


@pytest.fixture(scope="module")
def toy_data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder laid out as the shared pictures are, with one small picture of each kind."""
    folder = tmp_path_factory.mktemp("data")
    for kind in ("hdr", "photos", "environments"):
        (folder / kind).mkdir()
    portrait = read_portrait()
    write_rgb_exr(folder / "hdr" / "scene.exr", portrait.astype("float32"))
    write_rgb8(folder / "photos" / "scene.png", portrait)
    for name in ("lobby", "park"):
        assert cv2.imwrite(str(folder / "environments" / f"{name}.hdr"), portrait[::2, ::2].astype("float32"))
    return folder


def read_portrait() -> np.ndarray:
    picture = cv2.imread(str(ROOT / "udccal" / "data" / "portrait.jpg"))
    return cv2.resize(picture, (96, 64))[..., ::-1].copy()


@pytest.mark.medium
def test_fit_api_prints_the_noise_term() -> None:
    said = run("examples/fit_api.py")
    assert "CONVERGED" in said
    assert "K_DN_per_e" in said


def test_read_dng(shared_data: Path, tmp_path: Path) -> None:
    preview = tmp_path / "preview.png"
    said = run("examples/read_dng.py", shared_data / "raw" / "colorchart.dng", "--out", preview)
    assert "black 2056 DN" in said
    assert read_rgb8(preview).shape == (578, 867, 3)


def test_boards_intrinsics(shared_data: Path) -> None:
    assert "rms" in run("examples/boards_intrinsics.py", "--data", shared_data)


@pytest.mark.slow
def test_restore_shared_scenes(toy_rig: Path, toy_data: Path, tmp_path: Path) -> None:
    profile = tmp_path / "profile"
    calibrate = ["-m", "udccal.cli.main", "calibrate", "--rig", toy_rig, "--term", "noise"]
    run(*calibrate, "--session", tmp_path / "session", "--profile", profile)
    scenes = ["--data", toy_data, "--rig", toy_rig, "--size", "64", "--out", tmp_path / "out"]
    said = run("examples/restore_shared_scenes.py", "--profile", profile, *scenes)
    assert "mean gain" in said
    assert len(list((tmp_path / "out").glob("*.png"))) == 4


@pytest.mark.medium
def test_merge_bracket_lists_the_flicker_and_the_hit() -> None:
    said = run("examples/merge_bracket.py")
    assert "frame 4" in said
    assert "(20, 30)" in said


def test_noise_from_arrays() -> None:
    assert "CONVERGED" in run("examples/noise_from_arrays.py")


def test_array_calibration_says_how_sure_it_is() -> None:
    assert "px" in run("examples/array_calibration.py")


@pytest.mark.slow
def test_psf_from_stamps() -> None:
    assert "CONVERGED" in run("examples/psf_from_stamps.py")


@pytest.mark.slow
def test_psf_from_leds() -> None:
    said = run("examples/psf_from_leds.py")
    assert said.startswith("CONVERGED")
    opened = next(line.split() for line in said.splitlines() if line.startswith("row_open"))
    truth = float(load_profile("lg55-reduced").psf.term.diffraction.openings[1])
    assert abs(float(opened[1]) - truth) < 5 * float(opened[3])


def test_every_term_has_an_array_example_of_under_40_lines() -> None:
    names = "noise_from_arrays", "array_calibration", "wire_from_flat", "psf_from_leds", "backscatter_from_arrays"
    for name in names:
        lines = (ROOT / "examples" / f"{name}.py").read_text().splitlines()
        assert len(lines) < 40, name
        assert not any("udccal.cli" in line for line in lines), name


def test_own_camera_is_captured_with_and_fitted() -> None:
    said = run("examples/own_camera.py").splitlines()
    assert [line.split()[1] for line in said] == ["K_DN_per_e", "black_DN"]
    for line in said:
        status, _, value, _, sigma, _, truth = line.split()
        assert status == "CONVERGED:"
        assert abs(float(value) - float(truth)) < 4 * float(sigma)


def test_own_procedure_captures_a_session(tmp_path: Path) -> None:
    said = run("examples/own_procedure.py", tmp_path / "session").splitlines()
    assert [line.split(" of ")[0] for line in said] == ["wire/flat: 8 frames", "wire/dark: 4 frames"]


def test_own_term_is_fitted_and_its_sigma_propagated() -> None:
    *numbers, last = run("examples/own_term.py").splitlines()
    found = {name: (float(value), float(one), unit) for name, value, _, one, unit in map(str.split, numbers)}
    for name, truth, unit in (("light_e", 9000.0, "e-"), ("centre_x_px", 62.0, "px"), ("focal_px", 110.0, "px")):
        value, sigma, own = found[name]
        assert own == unit
        assert abs(value - truth) < 4 * sigma
    words = last.split()
    assert words[0] == "CONVERGED:"
    value, sigma = float(words[4]), float(words[6])
    truth = (1 + (62.0**2 + 50.0**2) / 110.0**2) ** -2
    assert 0 < sigma < 1e-3
    assert abs(value - truth) < 4 * sigma


def test_every_example_of_a_users_own_part_has_under_60_lines() -> None:
    for path in sorted((ROOT / "examples").glob("own_*.py")):
        assert len(path.read_text().splitlines()) < 60, path.name


def test_no_example_needs_the_command_line() -> None:
    for path in sorted((ROOT / "examples").glob("*.py")):
        assert "udccal.cli" not in path.read_text(), path.name


@pytest.mark.slow
def test_wire_from_flat() -> None:
    said = run("examples/wire_from_flat.py")
    assert "CONVERGED" in said
    assert "standoff_per_pitch" in said


@pytest.mark.slow
def test_backscatter_from_arrays() -> None:
    said = run("examples/backscatter_from_arrays.py")
    assert said.startswith("CONVERGED")
    gamma = next(line.split() for line in said.splitlines() if line.startswith("gamma"))
    value, sigma = float(gamma[1]), float(gamma[3])
    assert abs(value - load_profile("lg55-reduced").backscatter.estimate("gamma").value) < 1e-3
    assert 0 < sigma < 1e-3


@pytest.mark.slow
def test_the_tour_makes_the_pictures_of_its_page(tmp_path: Path) -> None:
    run("examples/tour.py", tmp_path, "--tiers", "preview")
    made = {file.name for file in tmp_path.iterdir()}
    page = (ROOT / "docs" / "tour.md").read_text(encoding="utf-8")
    assert made == {file.name for file in (ROOT / "docs" / "images").glob("tour_*")}
    assert all(f"images/{name}" in page for name in made)
    assert all(file.stat().st_size < 100_000 for file in tmp_path.iterdir())
