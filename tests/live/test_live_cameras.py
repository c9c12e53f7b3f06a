"""A real camera's driver under a live run: the virtual USB3 Vision camera."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest

from tests.cameras.small_tiff import Shot, write_dng
from tests.live.test_pipeline import SHAPE, ListSink, restore
from tests.virtual_u3v.backend import VirtualBackend
from tests.virtual_u3v.camera import VirtualCamera
from tests.virtual_u3v.faults import Faults
from tests.virtual_u3v.model import CameraModel
from udccal.cameras.protocol import Region, Settings
from udccal.cameras.u3v.camera import U3vCamera
from udccal.cli.jobs.live_cameras import LiveCamera, region_of
from udccal.errors import CameraError
from udccal.live.pipeline import Limits, Pipeline
from udccal.live.tally import Figures
from udccal.profiles.profile import Profile
from udccal.restoration.runtime import Restorer
from udccal.rig import RigDescription
from udccal.sessions.schema import StoredCamera
from udccal.tiers import Tier


@pytest.fixture
def plugged(live_rig: RigDescription, monkeypatch: pytest.MonkeyPatch) -> U3vCamera:
    camera = live_rig.camera
    model = CameraModel(columns=camera.columns, rows=camera.rows, cfa=camera.cfa, bits=camera.bits)
    return plug(model, Faults(), monkeypatch)


def plug(model: CameraModel, faults: Faults, monkeypatch: pytest.MonkeyPatch) -> U3vCamera:
    found = U3vCamera(backend=VirtualBackend([VirtualCamera(model, faults=faults)]), timeout_s=0.5)
    monkeypatch.setattr("udccal.cli.jobs.live_cameras.u3v_camera", lambda serial: found)
    return found


def run(profile: Profile) -> Figures:
    camera = LiveCamera("u3v", None, None, 2e-3, 25.0, 0)
    restorer = Restorer.from_profile(profile, Tier.preview)
    with camera.open(profile.rig) as deliver:
        frames, _ = deliver(restorer.view, None, restorer.seen_rows)
        pipeline = Pipeline(frames, restore, SHAPE, ListSink(), None, Limits(frames=5), threading.Event())
        return pipeline.run(lambda figures: None)


def test_it_is_set_and_streams_until_the_run_ends(live_profile: Profile, plugged: U3vCamera) -> None:
    asked: list[Settings] = []
    configure = plugged.configure
    plugged.configure = lambda settings: asked.append(settings) or configure(settings)
    assert run(live_profile).written == 5
    assert {settings.exposure_s for settings in asked} == {2e-3}
    with plugged:  # it can be opened again
        assert plugged.mode.frame_rate_hz == pytest.approx(25.0)


@pytest.mark.parametrize(
    ("rows", "steps", "expected"),
    [
        (slice(300, 700), (4, 2, 4, 2), (284, 432)),
        (slice(301, 700), (4, 16, 4, 16), (272, 448)),
        (slice(4, 1530), (4, 2, 4, 2), (0, 1536)),
        (slice(1000, 1536), (4, 2, 4, 2), (984, 552)),
        (slice(1000, 1530), (4, 500, 4, 500), (0, 1536)),
    ],
)
def test_rows_are_read_in_the_cameras_steps(
    rows: slice, steps: tuple[int, int, int, int], expected: tuple[int, int]
) -> None:
    assert region_of(rows, Region(0, 0, 2048, 1536), steps) == Region(0, expected[0], 2048, expected[1])


def test_it_reads_the_rows_that_the_view_needs(live_profile: Profile, plugged: U3vCamera) -> None:
    camera, restorer = LiveCamera("u3v", None, None, 2e-3, 25.0, 0), Restorer.from_profile(live_profile, Tier.preview)
    with camera.open(live_profile.rig) as deliver:
        frames, read = deliver(restorer.view, None, slice(24, 40))
        frame = next(iter(frames))
    assert read == slice(8, 56)
    assert frame.settings.region == Region(0, 8, 96, 48)
    assert frame.data.shape == (48, 96)


def test_one_that_falls_silent_ends_the_run(
    live_profile: Profile, live_rig: RigDescription, monkeypatch: pytest.MonkeyPatch
) -> None:
    camera = live_rig.camera
    model = CameraModel(columns=camera.columns, rows=camera.rows, cfa=camera.cfa, bits=camera.bits)
    plug(model, Faults(hang_at_frame=2), monkeypatch)
    with pytest.raises(CameraError, match="Expected"):
        run(live_profile)


def test_one_of_another_pattern_is_refused(live_profile: Profile, monkeypatch: pytest.MonkeyPatch) -> None:
    plug(CameraModel(columns=96, rows=64, cfa="GBRG"), Faults(), monkeypatch)
    with pytest.raises(CameraError, match="the pattern RGGB of the rig"):
        run(live_profile)


def test_one_of_another_size_is_refused(live_profile: Profile, monkeypatch: pytest.MonkeyPatch) -> None:
    plug(CameraModel(columns=128, rows=64, cfa="RGGB", bits=12), Faults(), monkeypatch)
    with pytest.raises(CameraError, match=r"a camera of 96 x 64, RGGB, 12 bits .* found 128 x 64, RGGB, 12 bits"):
        run(live_profile)


def test_another_specimen_than_the_profiles_is_refused(live_profile: Profile, plugged: U3vCamera) -> None:
    with plugged:
        own = plugged.identity
    made_with = StoredCamera(vendor=own.vendor, model=own.model, serial=own.serial, backend=own.backend)
    camera = LiveCamera("u3v", None, None, 2e-3, 25.0, 0)
    for changes in ({}, {"serial": "elsewhere", "backend": "pylon"}):
        with camera.open(live_profile.rig, made_with.model_copy(update=changes)):
            pass
    other = made_with.model_copy(update={"serial": "another"})
    with (
        pytest.raises(CameraError, match=r"the profile was made with, .*, serial another, found .*, serial"),
        camera.open(live_profile.rig, other),
    ):
        pass


def test_raw_files_of_another_pattern_are_refused(live_profile: Profile, tmp_path: Path) -> None:
    write_dng(tmp_path / "a.dng", np.full((64, 96), 900, np.uint16), Shot(cfa="BGGR"))
    camera = LiveCamera("files", None, tmp_path, None, 30.0, 0)
    with pytest.raises(CameraError, match=r"RGGB, 12 bits .* found 96 x 64, BGGR"), camera.open(live_profile.rig):
        pass


@pytest.mark.parametrize("exposure_s", [0.0, 1e300, float("nan")])
def test_an_exposure_that_cannot_be_is_refused(exposure_s: float) -> None:
    with pytest.raises(CameraError, match="a positive exposure in seconds from 1e-09 to 86400"):
        LiveCamera("sim", None, None, exposure_s, 30.0, 0)


def test_an_exposure_that_a_simulated_camera_lacks_is_refused_before_it_is_rendered(live_profile: Profile) -> None:
    camera = LiveCamera("sim", None, None, 1000.0, 30.0, 0)
    with pytest.raises(CameraError, match=r"an exposure in s from .* found 1000"), camera.open(live_profile.rig):
        pass


def test_files_play_once(tmp_path: Path, live_profile: Profile) -> None:
    with (
        pytest.raises(CameraError, match="Expected pictures"),
        LiveCamera("files", None, tmp_path, 1e-3, 30.0, 0).open(live_profile.rig),
    ):
        pass
