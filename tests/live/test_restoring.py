"""Restoration of a live run's frames, and profiles that change meanwhile."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

from tests.live.conftest import COLUMNS, NOISE, ROWS, profile_of, raw_frame
from tests.live.test_pipeline import ListSink
from tests.restoration.test_device import panel_light
from tests.scenes import toy_restorer
from udccal.cameras.protocol import Frame, Region
from udccal.errors import LiveError, ProfileError, RestorationError
from udccal.live.exposure import AutoExposure
from udccal.live.follow import ProfileFollower
from udccal.live.own_pictures import OwnPictures
from udccal.live.pacing import looped
from udccal.live.pipeline import Limits, Pipeline
from udccal.live.restoring import Restoring
from udccal.profiles.profile import Profile
from udccal.profiles.store import write_profile
from udccal.restoration.device.restorer import DeviceRestorer
from udccal.restoration.panel_mask import PanelMask
from udccal.restoration.runtime import Restorer
from udccal.restoration.tone import Tone, display_exposure
from udccal.rig import RigDescription, load_rig
from udccal.tiers import Tier


def test_the_first_picture_is_exposed_as_a_still_one() -> None:
    linear = np.random.default_rng(1).gamma(2.0, 1e4, (40, 64, 3)).astype(np.float32) - 100
    assert AutoExposure(linear, 1.0, np.inf).tone == Tone(display_exposure(linear[::8, ::8]))


def test_exposure_follows_the_light_slowly() -> None:
    linear = np.full((64, 64, 3), 1e4, np.float32)
    follower = AutoExposure(linear, 1.0, np.inf)
    first = int(follower.tone.rgb8(linear).max())
    jump = follower.tone.rgb8(linear / 4)
    assert jump.max() < 0.6 * first
    for _ in range(80):
        follower.follow(follower.tone.rgb8(linear / 4), np.inf)
    assert int(follower.tone.rgb8(linear / 4).max()) == pytest.approx(first, abs=1)
    linear /= 4
    linear[:16] *= 8  # some of it far too bright
    for _ in range(80):
        assert follower.follow(follower.tone.rgb8(linear), np.inf)
    assert int(follower.tone.rgb8(linear).max()) == pytest.approx(first, abs=1)
    assert not follower.follow(follower.tone.rgb8(linear * 100), np.inf)


def test_light_that_clips_stays_white_and_is_followed() -> None:
    linear = np.full((64, 64, 3), 1e4, np.float32)
    follower = AutoExposure(linear, 1.0, 1e4)
    for _ in range(80):
        assert follower.tone.rgb8(linear).min() == 255
        assert follower.follow(follower.tone.rgb8(linear), 1e4)
    for _ in range(80):
        follower.follow(follower.tone.rgb8(linear), np.inf)
    assert int(follower.tone.rgb8(linear).max()) == pytest.approx(0.9 * 255, abs=1)


@pytest.fixture
def restoring(live_profile: Profile) -> Restoring:
    return Restoring(Restorer.from_profile(live_profile, Tier.preview))


def test_a_dark_beginning_and_a_sudden_light_are_left_with_the_next_frame(restoring: Restoring) -> None:
    """Neither is noise of the dark amplified to white."""
    rng = np.random.default_rng(4)
    dark = replace(raw_frame(0), data=rng.normal(64.0, 2.0, (64, 96)).astype(np.uint16))
    assert np.median(restoring.restore(dark, 0)) < 100
    sudden, *later = (np.percentile(restoring.restore(raw_frame(n, level=3000), 0), 97) for n in range(1, 4))
    assert sudden == 255
    np.testing.assert_allclose(later, 0.9 * 255, atol=2)


def test_frames_of_another_camera_are_refused(restoring: Restoring) -> None:
    assert restoring.shape == (ROWS, COLUMNS)
    assert restoring.restore(raw_frame(0), 0).shape == (ROWS, COLUMNS, 3)
    frame = raw_frame(0)
    with pytest.raises(RestorationError, match="96 x 64"):
        restoring.restore(replace(frame, data=frame.data[:32]), 0)


def test_a_profile_of_another_view_is_refused(restoring: Restoring, live_rig: RigDescription) -> None:
    larger = live_rig.model_copy(update={"view": live_rig.view.model_copy(update={"columns": 32, "rows": 18})})
    with pytest.raises(LiveError, match=r"view of 64 x 36.* found .* 32 x 18. Start another run"):
        restoring.replace(Restorer.from_profile(profile_of(larger), Tier.preview))


@pytest.mark.parametrize(
    ("part", "change", "message"),
    [
        ("camera", {"bits": 10}, r"samples of 12 bits, .* found .* samples of 10 bits"),
        ("panel", {"rows": 25}, r"a panel of 32 x 24 .* found .* a panel of 32 x 25"),
    ],
)
def test_a_profile_whose_frames_or_panel_pictures_are_others_is_refused(
    live_rig: RigDescription, live_profile: Profile, part: str, change: dict[str, int], message: str
) -> None:
    """Else it would end the run at the next frame."""
    restoring = Restoring(Restorer.from_profile(live_profile, Tier.preview), np.zeros((24, 32, 3), np.uint8))
    other = live_rig.model_copy(update={part: getattr(live_rig, part).model_copy(update=change)})
    with pytest.raises(LiveError, match=message):
        restoring.replace(replace(restoring._restorer, rig=other))
    restoring.restore(raw_frame(0, level=3000), 0)


def part_of(frame: Frame, rows: slice) -> Frame:
    """The frame as a camera delivers it that reads these rows alone."""
    region = Region(0, rows.start, frame.data.shape[1], rows.stop - rows.start)
    return replace(frame, data=frame.data[rows].copy(), settings=replace(frame.settings, region=region))


@pytest.mark.parametrize("tier", [Tier.preview, Tier.fast])
def test_rows_that_the_view_needs_are_enough(live_profile: Profile, tier: Tier) -> None:
    restorer = Restorer.from_profile(live_profile, tier)
    needed, rng = restorer.seen_rows, np.random.default_rng(2)
    frames = [replace(raw_frame(i), data=rng.integers(500, 3000, (64, 96)).astype(np.uint16)) for i in range(3)]
    whole, read = Restoring(restorer), Restoring(restorer)
    for frame in frames:
        np.testing.assert_array_equal(whole.restore(frame, 0), read.restore(part_of(frame, needed), 0))
    if tier is Tier.preview:
        assert (needed.start, needed.stop) != (0, 64)
        with pytest.raises(LiveError, match=rf"Expected rows {needed.start} to .* reads rows {needed.start + 2} to"):
            read.restore(part_of(frames[0], slice(needed.start + 2, 64)), 0)


@pytest.mark.medium
def test_a_device_shows_the_same() -> None:
    restorer = toy_restorer.made(Tier.balanced, toy_restorer.rig(), NOISE, toy_restorer.geometry(), toy_restorer.grid())
    on_device = Restoring(restorer, None, jax.devices("cpu")[0])
    assert isinstance(on_device._shows, DeviceRestorer)
    settings = replace(raw_frame(0).settings, region=Region(0, 0, toy_restorer.COLUMNS, toy_restorer.ROWS))
    data = toy_restorer.exposed(restorer, toy_restorer.grid(), toy_restorer.scene())
    frame = replace(raw_frame(0), data=data, settings=replace(settings, exposure_s=toy_restorer.EXPOSURE_S))
    off = on_device.restore(frame, 0).astype(int) - Restoring(restorer).restore(frame, 0)
    assert np.abs(off).max() <= 2


def test_a_profile_whose_view_needs_other_rows_is_refused(restoring: Restoring) -> None:
    restorer = restoring._restorer
    restoring.restore(part_of(raw_frame(0), restorer.seen_rows), 0)
    with pytest.raises(LiveError, match="which the view needs"):
        restoring.replace(replace(restorer, rectification=restorer.rectification.from_row(4)))
    restoring.replace(restorer)


def test_rows_that_are_not_read_are_refused_before_the_first_frame(live_profile: Profile) -> None:
    restorer = Restorer.from_profile(live_profile, Tier.preview)
    restoring = Restoring(restorer, read=restorer.seen_rows)
    with pytest.raises(LiveError, match="which the view needs"):
        restoring.replace(replace(restorer, rectification=restorer.rectification.from_row(4)))
    restoring.restore(part_of(raw_frame(0), restorer.seen_rows), 0)
    few = slice(restorer.seen_rows.start + 2, restorer.seen_rows.stop)
    with pytest.raises(LiveError, match="which the view needs"):
        Restoring(restorer, read=few)


def test_a_mirrors_panel_shows_the_newest_picture_that_was_there() -> None:
    pictures = [np.full((9, 16, 3), 10 * n, np.uint8) for n in range(3)]
    own = OwnPictures(load_rig("lg55-reduced").panel.model_copy(update={"columns": 32, "rows": 18}), 0.02)
    assert own.at(10**12) is None
    for n, picture in enumerate(pictures):
        own.wrote(picture, n * 10**9)
    for at_ns, expected in ((0, None), (10**9, 0), (1_020_000_000, 10), (1_990_000_000, 10), (9 * 10**9, 20)):
        found = own.at(at_ns)
        if expected is None:
            assert found is None
        else:
            assert found is not None
            assert found.shape == (18, 32, 3)
            assert set(found.ravel()) == {expected}


@pytest.mark.parametrize(("rate_hz", "delay_s"), [(30, 0.5), (120, 0.3), (500, 0.5)])
def test_a_picture_is_kept_until_the_next_one_is_on_the_panel(rate_hz: int, delay_s: float) -> None:
    """However fast pictures come, and though a frame waits a while for its restoration."""
    own = OwnPictures(load_rig("lg55-reduced").panel.model_copy(update={"columns": 1, "rows": 1}), delay_s)
    period_ns, delayed = 10**9 // rate_hz, round(delay_s * rate_hz)
    for n in range(2 * rate_hz):
        own.wrote(np.full((1, 1, 3), n % 251, np.uint8), n * period_ns)
        waiting = max(n - rate_hz // 10, 0)
        found = own.at(waiting * period_ns + period_ns // 2)
        assert (None if found is None else found[0, 0, 0]) == (None if waiting < delayed else (waiting - delayed) % 251)


def test_pictures_that_no_frame_asks_for_are_forgotten() -> None:
    own = OwnPictures(load_rig("lg55-reduced").panel, 0.1)
    for n in range(1000):
        own.wrote(np.zeros((1, 1, 3), np.uint8), n * 10**7)
    assert len(own._written) < 120


@pytest.mark.parametrize("tier", [Tier.preview, Tier.fast])
def test_a_frame_darker_than_the_panels_picture_is_restored_without_it(tier: Tier) -> None:
    rig, panel = toy_restorer.rig(), panel_light(toy_restorer.rig())
    white = np.full((rig.panel.rows, rig.panel.columns, 3), 255, np.uint8)
    plain = toy_restorer.made(tier, rig, NOISE, toy_restorer.geometry(), toy_restorer.grid())
    mask = PanelMask(panel.rate(white)[plain.rows], panel.cfa, 0.0)
    restorer = replace(plain, mask=mask, panel=None if tier is Tier.preview else panel.of_rows(plain.rows))
    settings = replace(raw_frame(0).settings, region=Region(0, 0, toy_restorer.COLUMNS, toy_restorer.ROWS))
    dark, bright = (
        replace(
            raw_frame(n),
            data=np.full((toy_restorer.ROWS, toy_restorer.COLUMNS), level, np.uint16),
            settings=replace(settings, exposure_s=toy_restorer.EXPOSURE_S),
        )
        for n, level in enumerate((66, 2000))
    )
    known, unknown, refused = Restoring(restorer, white), Restoring(restorer), list[str]()

    def restored(frame: Frame) -> np.ndarray:
        return known.restore(frame, 0, lambda: refused.append("dark"))

    np.testing.assert_array_equal(restored(dark), unknown.restore(dark, 0))
    assert refused == ([] if tier is Tier.preview else ["dark"])  # a preview estimates the panel's light always
    restored(bright)
    assert len(refused) <= 1
    restored(dark)
    assert len(refused) == (0 if tier is Tier.preview else 2)


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


ENDING = """
import sys, time
from pathlib import Path
from udccal.live.follow import ProfileFollower

folder = Path(sys.argv[1])

def take():
    (folder / "begun").touch()
    time.sleep(2.0)
    (folder / "whole").touch()

with ProfileFollower(folder, take, print):
    (folder / "profile.json").write_text("another one")
    while not (folder / "begun").exists():
        time.sleep(0.01)
"""


@pytest.mark.medium
def test_a_program_ends_after_a_profile_that_is_being_loaded(profile_folder: Path) -> None:
    """Python aborts where native code works on in a daemon."""
    words = [sys.executable, "-c", ENDING, str(profile_folder)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120, cwd=Path(__file__).parents[2])
    assert (done.returncode, done.stderr) == (0, "")
    assert (profile_folder / "whole").exists()
    assert done.stdout == f"The profile {profile_folder} is still being loaded; the program ends after that.\n"


class Following:
    """A profile that is followed, whose loading fails as it is told to, and what was said and tried."""

    def __init__(self, folder: Path) -> None:
        self.error: Exception | None = None
        self.said: list[str] = []
        self.tried = 0
        self.follower = ProfileFollower(folder, self.take, self.said.append)

    def take(self) -> None:
        self.tried += 1
        if self.error is not None:
            raise self.error

    def wait(self, more: int = 3) -> None:
        """Wait until the profile has been tried again so many times."""
        wanted, deadline = self.tried + more, time.monotonic() + 30
        while self.tried < wanted and time.monotonic() < deadline:
            time.sleep(0.002)
        assert self.tried >= wanted


@pytest.fixture
def following(profile_folder: Path, monkeypatch: pytest.MonkeyPatch) -> Following:
    monkeypatch.setattr("udccal.live.follow._EVERY_S", 0.01)
    return Following(profile_folder)


def test_a_profile_that_comes_file_by_file_is_taken_up_when_it_is_whole(
    profile_folder: Path, following: Following
) -> None:
    following.error = ProfileError("Expected wire.exr, found none.")
    (profile_folder / "profile.json").touch()
    with following.follower:
        following.wait()
        following.error = ProfileError("Expected psf.exr, found none.")
        following.wait()
        (profile_folder / "profile.json").touch()
        following.wait()
        following.error = None  # the last file is there; profile.json has stayed as it was
        following.wait(1)
        time.sleep(0.1)
        tried = following.tried
        time.sleep(0.1)
    assert following.tried == tried
    assert ["wire.exr" in said for said in following.said] == [True, False, False, False]
    assert ["psf.exr" in said for said in following.said] == [False, True, True, False]
    assert "restored with the new one" in following.said[-1]


def test_a_profile_of_another_camera_is_tried_once(profile_folder: Path, following: Following) -> None:
    following.error = LiveError("Expected a changed profile of 96 x 64, found one of 48 x 32.")
    (profile_folder / "profile.json").touch()
    with following.follower:
        following.wait(1)
        time.sleep(0.1)
    assert following.tried == len(following.said) == 1
