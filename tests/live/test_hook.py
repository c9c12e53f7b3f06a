from __future__ import annotations

import sys
import threading
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from examples.follow_hook import Follower
from udccal.errors import LiveError
from udccal.live.hook import Picture, TimedHook, load_hook

PICTURE = np.full((4, 6, 3), 100, np.uint8)


def brighter(picture: Picture, frame_id: int) -> Picture:
    picture += np.uint8(frame_id)
    return picture


def test_a_hook_alters_a_copy() -> None:
    altered = TimedHook(brighter, 10.0).apply(PICTURE, 3)
    assert altered is not None
    assert np.all(altered == 103)
    assert np.all(PICTURE == 100)


def test_a_view_that_is_turned_is_laid_out_anew() -> None:
    altered = TimedHook(lambda picture, frame_id: picture[:, ::-1, ::-1], 10.0).apply(PICTURE, 0)
    assert altered is not None
    assert altered.flags.c_contiguous


def test_a_late_hook_is_passed_by_until_it_has_ended() -> None:
    go_on, calls = threading.Event(), list[int]()

    def slow(picture: Picture, frame_id: int) -> Picture:
        calls.append(frame_id)
        if frame_id == 0:
            go_on.wait()
        return brighter(picture, frame_id)

    hook = TimedHook(slow, 0.05)
    start = time.monotonic()
    assert hook.apply(PICTURE, 0) is None
    assert time.monotonic() - start >= 0.05
    assert hook.apply(PICTURE, 1) is None
    assert calls == [0]
    go_on.set()
    hook = wait_for(hook)
    altered = hook.apply(PICTURE, 2)
    assert altered is None or np.all(altered == 102)  # never the late picture of frame 0
    assert 1 not in calls


def wait_for(hook: TimedHook) -> TimedHook:
    deadline = time.monotonic() + 10
    while hook._answers.empty() and time.monotonic() < deadline:
        time.sleep(0.001)
    return hook


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda picture, frame_id: 1 / 0, "found ZeroDivisionError: division by zero. Correct the hook"),
        (lambda picture, frame_id: sys.exit("no model"), "found SystemExit: no model. Correct the hook"),
        (lambda picture, frame_id: None, "found NoneType"),
        (lambda picture, frame_id: picture[1:], r"of shape \(4, 6, 3\), found uint8 of shape \(3, 6, 3\)"),
        (lambda picture, frame_id: picture.astype(float), "found float64"),
    ],
)
def test_what_a_hook_must_not_do(function: object, message: str) -> None:
    with pytest.raises(LiveError, match=message):
        TimedHook(function, 10.0).apply(PICTURE, 0)


@pytest.mark.parametrize("limit_s", [0.0, -1.0, float("nan"), float("inf")])
def test_a_hook_has_a_limit(limit_s: float) -> None:
    with pytest.raises(LiveError, match=r"a hook's limit in s from 0.0001 to 60, found"):
        TimedHook(brighter, limit_s)


def test_a_hook_is_found_in_the_present_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "hook_of_mine.py").write_text("LEVEL = 3\ndef same(picture, frame_id):\n    return picture\n")
    monkeypatch.chdir(tmp_path)
    assert load_hook("hook_of_mine:same")(PICTURE, 0) is PICTURE
    for wrong in ("hook_of_mine:other", "no_such_module_here:same", "hook_of_mine", ":", "hook_of_mine:LEVEL"):
        with pytest.raises(LiveError, match="--hook"):
            load_hook(wrong)


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("def same(picture, frame_id)\n    return picture\n", r"SyntaxError: expected ':' \(broken_hook.py, line 1\)"),
        ("LEVEL = 1 / 0\n", "ZeroDivisionError: division by zero"),
        ("import sys\nsys.exit('Usage: broken_hook.py FILE')\n", "SystemExit: Usage: broken_hook.py FILE"),
        ("import no_such_module_here\n", "ModuleNotFoundError: No module named 'no_such_module_here'"),
    ],
)
def test_a_module_that_cannot_be_imported_is_said_with_its_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, source: str, message: str
) -> None:
    (tmp_path / "broken_hook.py").write_text(source)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(LiveError, match=f"found for 'broken_hook:same': {message}"):
        load_hook("broken_hook:same")


def test_a_module_is_named_in_full() -> None:
    with pytest.raises(LiveError, match=r"found for '\.m:f': TypeError: .*relative import"):
        load_hook(".m:f")


def test_the_modules_folder_alone_leaves_the_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.path", list(sys.path))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "appending_hook.py").write_text(
        "import sys\nsys.path.append('/of/the/hook')\ndef same(picture, frame_id):\n    return picture\n"
    )
    before = list(sys.path)
    load_hook("appending_hook:same")
    assert sys.path == [*before, "/of/the/hook"]
    sys.path.insert(0, str(tmp_path))  # a person's own entry stays where it is
    load_hook("appending_hook:same")
    assert sys.path == [str(tmp_path), *before, "/of/the/hook"]


def test_the_examples_cross_stays_on_the_scene() -> None:
    rng = np.random.default_rng(2)
    scene = cv2.GaussianBlur(rng.integers(0, 255, (240, 640, 3)).astype(np.uint8), (0, 0), 6)
    scene = cv2.normalize(scene, None, 0, 255, cv2.NORM_MINMAX)
    follower = Follower()
    for step in range(0, 60, 6):
        shown = follower.overlay(scene[20:200, 40 + step : 360 + step].copy(), step)
    marked = np.argwhere(np.all(shown == (255, 0, 0), axis=-1)).mean(axis=0)
    assert marked == pytest.approx([90, 160 - 54], abs=2.0)
