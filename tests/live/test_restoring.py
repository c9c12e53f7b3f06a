"""Restoration of a live run's frames, and profiles that change meanwhile."""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.live.conftest import COLUMNS, NOISE, ROWS, profile_of, raw_frame
from tests.live.test_pipeline import ListSink
from udccal.errors import LiveError, RestorationError
from udccal.live.exposure import AutoExposure
from udccal.live.follow import ProfileFollower
from udccal.live.pacing import looped
from udccal.live.pipeline import Limits, Pipeline
from udccal.live.restoring import Restoring
from udccal.profiles.profile import Profile
from udccal.profiles.store import write_profile
from udccal.restoration.runtime import Restorer
from udccal.restoration.tone import Tone, display_exposure
from udccal.rig import RigDescription
from udccal.tiers import Tier


def test_the_first_picture_is_exposed_as_a_still_one() -> None:
    linear = np.random.default_rng(1).gamma(2.0, 1e4, (40, 64, 3)).astype(np.float32) - 100
    assert AutoExposure(linear).tone == Tone(display_exposure(linear[::8, ::8]))


def test_exposure_follows_the_light_slowly() -> None:
    linear = np.full((16, 16, 3), 1e4, np.float32)
    follower = AutoExposure(linear)
    first = int(follower.tone.rgb8(linear).max())
    jump = follower.tone.rgb8(linear / 4)
    assert jump.max() < 0.6 * first
    for _ in range(80):
        follower.follow(follower.tone.rgb8(linear / 4))
    assert int(follower.tone.rgb8(linear / 4).max()) == pytest.approx(first, abs=1)
    for _ in range(80):
        follower.follow(follower.tone.rgb8(linear * 8))
    assert int(follower.tone.rgb8(linear * 8).max()) == pytest.approx(first, abs=1)


def test_a_black_beginning_is_left_within_two_seconds() -> None:
    black, linear = np.zeros((16, 16, 3), np.float32), np.full((16, 16, 3), 1e4, np.float32)
    follower = AutoExposure(black)
    assert not follower.tone.rgb8(black).any()
    follower.follow(follower.tone.rgb8(black))
    assert np.isfinite(follower.tone.exposure)
    for _ in range(60):
        follower.follow(follower.tone.rgb8(linear))
    assert follower.tone.rgb8(linear).max() < 255


@pytest.fixture
def restoring(live_profile: Profile) -> Restoring:
    return Restoring(Restorer.from_profile(live_profile, Tier.preview))


def test_frames_of_another_camera_are_refused(restoring: Restoring) -> None:
    assert restoring.shape == (ROWS, COLUMNS)
    assert restoring.restore(raw_frame(0)).shape == (ROWS, COLUMNS, 3)
    frame = raw_frame(0)
    with pytest.raises(RestorationError, match="96 x 64"):
        restoring.restore(replace(frame, data=frame.data[:32]))


def test_a_profile_of_another_view_is_refused(restoring: Restoring, live_rig: RigDescription) -> None:
    larger = live_rig.model_copy(update={"view": live_rig.view.model_copy(update={"columns": 32, "rows": 18})})
    with pytest.raises(LiveError, match=r"view of 64 x 36.* found .* 32 x 18. Start another run"):
        restoring.replace(Restorer.from_profile(profile_of(larger), Tier.preview))


def test_a_changed_profile_is_taken_up_between_two_frames(
    restoring: Restoring, live_rig: RigDescription, profile_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No frame waits while the profile is read, and a broken one changes nothing."""
    monkeypatch.setattr("udccal.live.follow._EVERY_S", 0.02)
    said: list[str] = []
    told = threading.Event()

    def say(sentence: str) -> None:
        said.append(sentence)
        told.set()

    levels: list[float] = []
    written_meanwhile: list[int] = []

    def take() -> None:
        before = len(levels)
        restorer = Restorer.load(profile_folder, Tier.preview)
        written_meanwhile.append(len(levels) - before)
        restoring.replace(restorer)

    class LevelSink(ListSink):
        def open(self, shape: tuple[int, int]) -> None:
            self.calls.append("open")

        def write(self, frame: object) -> None:
            levels.append(restoring._restorer.noise.black_DN)

    stop = threading.Event()
    run = Pipeline(looped([raw_frame(0)], 100.0), restoring.restore, restoring.shape, LevelSink(), None, Limits(), stop)
    running = threading.Thread(target=run.run, args=(lambda figures: None,), daemon=True)
    with ProfileFollower(profile_folder, take, say):
        running.start()
        write_profile(profile_folder, profile_of(live_rig, replace(NOISE, black_DN=70.0)))
        assert told.wait(60)
        assert "restored with the new one" in said[0]
        told.clear()
        (profile_folder / "profile.json").write_text("{}")
        assert told.wait(60)
        assert "the earlier one is kept" in said[1]
        time.sleep(0.1)
    stop.set()
    running.join(30)
    assert not running.is_alive()
    assert set(levels) == {64.0, 70.0}
    assert levels == sorted(levels)
    assert written_meanwhile[0] > 3


def test_a_change_before_the_run_begins_is_taken_up(profile_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("udccal.live.follow._EVERY_S", 0.01)
    taken = threading.Event()
    follower = ProfileFollower(profile_folder, taken.set, lambda sentence: None)
    (profile_folder / "profile.json").touch()
    with follower:
        assert taken.wait(30)
