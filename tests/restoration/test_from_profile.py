"""A profile with every term present, through the whole runtime."""

from __future__ import annotations

import inspect
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from udccal.errors import RestorationError
from udccal.io.png import write_png16, write_rgb8
from udccal.profiles.profile import Profile, build_profile
from udccal.profiles.store import read_profile, write_profile
from udccal.restoration.plan import PlanOptions
from udccal.restoration.runtime import Restorer
from udccal.result import FitResult, FitStatus
from udccal.rig import load_rig
from udccal.tiers import Tier


@pytest.mark.parametrize("tier", list(Tier))
def test_a_stored_profile_restores_a_frame(profile: Profile, tmp_path: Path, tier: Tier) -> None:
    write_profile(tmp_path / "p", profile)
    options = PlanOptions(grid_rows=2, grid_columns=2, tile_rows=96, tile_columns=128)
    restorer = Restorer.from_profile(read_profile(tmp_path / "p"), tier, options)
    rig, exposure_s = profile.rig, 0.02
    picture = np.full((rig.panel.rows, rig.panel.columns, 3), 255, np.uint8)
    scene_e = 2000.0
    assert restorer.mask is not None
    backscatter_e = exposure_s * restorer.mask.white
    frame = np.rint(64 + 0.355 * (scene_e + backscatter_e + 20 * exposure_s)).astype(np.uint16)
    # The preview does not ask what the panel shows.
    for shown in (picture,) if tier is Tier.preview else (picture, np.zeros_like(picture)):
        expected = scene_e + (0.0 if shown.any() else backscatter_e.mean())
        restored = restorer.restore(frame, exposure_s, shown)
        np.testing.assert_allclose(restored * exposure_s, expected, rtol=0.02)
    # Without the picture, an even frame might be all backscatter: no more than the mask is taken away.
    unknown = restorer.restore(frame, exposure_s)
    np.testing.assert_allclose(unknown * exposure_s, scene_e, rtol=0.02)


@pytest.mark.slow
def test_a_frame_darker_than_the_panels_light_is_refused(profile: Profile, tmp_path: Path) -> None:
    """Milliseconds given as seconds to the command, and the same frame with its own exposure."""
    rig = profile.rig.model_copy(update={"panel": load_rig("lg55-reduced").panel})
    whole_panel = build_profile(rig, profile.provenance, *profile.results, profile.wire_map)
    write_profile(tmp_path / "p", whole_panel)
    write_rgb8(tmp_path / "shown.png", np.full((rig.panel.rows, rig.panel.columns, 3), 255, np.uint8))
    mask = Restorer.from_profile(whole_panel, Tier.preview).mask
    assert mask is not None
    exposure_s = 6.0 / mask.white.mean()  # the panel gives 6 e- per pixel then, the scene 2000
    write_png16(tmp_path / "frame.png", np.rint(64 + 0.355 * (2000.0 + exposure_s * mask.white)).astype(np.uint16))
    words = ["restore", "frame.png", "--profile", "p", "--panel-picture", "shown.png", "--tier", "fast", "--out", "out"]
    for given_s, status in ((1000 * exposure_s, 1), (exposure_s, 0)):
        command = [sys.executable, "-m", "udccal.cli.main", *words, "--exposure-s", str(given_s), "--json"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=280, cwd=tmp_path)
        assert done.returncode == status, done.stderr
        assert (tmp_path / "out").exists() is (status == 0)
        if status:
            assert "Expected a frame at least as bright as the panel's own light" in json.loads(done.stdout)["error"]


def test_a_folder_to_keep_that_is_no_path_is_refused(profile: Profile) -> None:
    made = inspect.unwrap(Restorer.from_profile.__func__)  # programs do not have the tests' own check of types
    with pytest.raises(RestorationError, match="the path of a folder that keeps what is computed, found 5"):
        made(Restorer, profile, Tier.preview, keep=5)


def test_a_folder_to_keep_that_is_a_file_is_refused(profile: Profile, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(RestorationError, match="a folder that keeps what is computed, found the file"):
        Restorer.from_profile(profile, Tier.preview, keep=tmp_path / "file")


def test_absent_terms_cost_nothing(profile: Profile) -> None:
    def absent(term: FitResult) -> FitResult:
        return replace(term, status=FitStatus.ABSENT)

    without = replace(
        profile, wire=absent(profile.wire), psf=absent(profile.psf), backscatter=absent(profile.backscatter)
    )
    restorer = Restorer.from_profile(without)
    assert restorer.wire is None
    assert restorer.sharpener is None
    assert restorer.panel is None
    frame = np.full((profile.rig.camera.rows, profile.rig.camera.columns), 64 + round(0.355 * 2000), np.uint16)
    np.testing.assert_allclose(restorer.restore(frame, 0.02) * 0.02, 2000.0, rtol=0.01)


def test_the_shading_of_a_wire_that_is_not_there_stays(profile: Profile) -> None:
    shaded = replace(
        profile,
        wire=replace(profile.wire, status=FitStatus.ABSENT),
        wire_map=profile.wire_map * np.linspace(0.8, 1.2, profile.rig.camera.columns, dtype=np.float32),
    )
    assert Restorer.from_profile(shaded, Tier.preview).wire is not None


def test_terms_that_give_no_numbers_are_refused_when_made_ready(profile: Profile) -> None:
    options = PlanOptions(grid_rows=2, grid_columns=2)
    psf, backscatter = profile.psf.term, profile.backscatter.term
    dark = replace(psf, residual=np.zeros(np.shape(psf.residual)))
    with pytest.raises(RestorationError, match="Expected kernels that sum to 1"):
        Restorer.from_profile(replace(profile, psf=replace(profile.psf, term=dark)), options=options)
    nowhere = replace(backscatter, geometry=replace(backscatter.geometry, principal_point_px=np.array([np.nan, 0.0])))
    with pytest.raises(RestorationError, match="Expected a footprint"):
        Restorer.from_profile(replace(profile, backscatter=replace(profile.backscatter, term=nowhere)), options=options)
