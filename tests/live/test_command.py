"""``udccal run`` as a person starts it, with a tiny profile."""

from __future__ import annotations

import json
import os
import secrets
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import cv2
import jax
import numpy as np
import pytest

from examples.read_live import frames
from tests.ctrl_c import heeding_ctrl_c
from tests.live.conftest import COLUMNS, ROWS
from tests.live.test_live_cameras import plug
from tests.virtual_u3v.faults import Faults
from tests.virtual_u3v.model import CameraModel
from udccal.cli.jobs.live import LiveRun, _ended_by_signals, run_live
from udccal.cli.jobs.live_cameras import LiveCamera
from udccal.cli.output import Output
from udccal.errors import CameraError, LiveError, PanelPictureError, UdccalError
from udccal.io.png import read_rgb8, write_png16, write_rgb8
from udccal.live.own_pictures import OwnPictures
from udccal.live.pipeline import Limits
from udccal.restoration.runtime import Restorer
from udccal.rig import RigDescription
from udccal.tiers import Tier

ROOT = Path(__file__).resolve().parents[2]
pytestmark = pytest.mark.medium


def command(*words: str | Path) -> list[str]:
    return [sys.executable, "-m", "udccal.cli.main", "run", *map(str, words), "--json"]


def udccal_run(*words: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command(*words), capture_output=True, text=True, timeout=1000, cwd=ROOT)


def write_raw_files(folder: Path, count: int) -> Path:
    folder.mkdir()
    rng = np.random.default_rng(5)
    for number in range(count):
        write_png16(folder / f"{number}.png", rng.integers(500, 3000, (64, 96)).astype(np.uint16))
    return folder


def test_files_become_images(profile_folder: Path, tmp_path: Path) -> None:
    raw_files = write_raw_files(tmp_path / "raw", 6)
    (tmp_path / "my_hook.py").write_text("def mark(p, n):\n    p[0, 0] = n\n    return p\n")
    log, out = tmp_path / "log.jsonl", tmp_path / "out"
    log.write_text("of an earlier run")
    source = ["--camera", "files", "--files", raw_files, "--exposure-s", "0.001", "--fps", "1"]
    hook = ["--hook", "my_hook:mark", "--hook-ms", "2000"]
    words = command("--profile", profile_folder, "--sink", f"images:{out}", "--log", log, *source, *hook)
    path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    done = subprocess.run(
        words, capture_output=True, text=True, timeout=250, cwd=tmp_path, env={**os.environ, "PYTHONPATH": path}
    )
    assert done.returncode == 0, done.stderr
    shown = json.loads(done.stdout)
    assert (shown["captured"], shown["written"], shown["late_hooks"]) == (6, 6, 0)
    files = sorted(out.iterdir())
    assert [file.name for file in files] == [f"frame-{number:08d}.png" for number in range(6)]
    picture = read_rgb8(files[5])
    assert picture.shape == (ROWS, COLUMNS, 3)
    assert np.all(picture[0, 0] == 5)
    *seconds, whole = [json.loads(line) for line in log.read_text().splitlines()]
    assert whole == {**shown, "elapsed_s": whole["elapsed_s"]}
    assert len(seconds) >= 2
    assert {line["span"] for line in seconds} == {"second"}


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_and_removes_the_shared_memory(
    profile_folder: Path, tmp_path: Path, number: signal.Signals
) -> None:
    name = f"udccal-test-{secrets.token_hex(6)}"
    raw_files = write_raw_files(tmp_path / "raw", 300)
    source = ["--camera", "files", "--files", raw_files, "--exposure-s", "0.001", "--fps", "5"]
    words = command("--profile", profile_folder, "--sink", f"shm:{name}", *source)
    pipe = subprocess.PIPE
    with subprocess.Popen(words, stdout=pipe, stderr=pipe, text=True, cwd=ROOT, preexec_fn=heeding_ctrl_c) as running:
        deadline = time.monotonic() + 200
        while not Path("/dev/shm", name).exists() and running.poll() is None and time.monotonic() < deadline:
            time.sleep(0.05)
        seen = [frame_id for (frame_id, _), _ in zip(frames(name), range(3), strict=False)]
        running.send_signal(number)
        said, complained = running.communicate(timeout=60)
    assert running.returncode == 0, complained
    assert seen == sorted(set(seen))
    assert json.loads(said)["written"] >= 3
    assert not Path("/dev/shm", name).exists()


def test_a_sink_that_is_not_here_is_refused(profile_folder: Path) -> None:
    done = udccal_run("--profile", profile_folder, "--sink", "window:")
    assert done.returncode == 1
    assert "a desktop to open a window on, found none" in json.loads(done.stdout)["error"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sink": "paper:x"}, "sink 'paper'"),
        ({"hook": "none:at_all"}, "--hook"),
        ({"log": Path("/none/log")}, "--log"),
        ({}, "no-such-profile"),
    ],
)
def test_what_cannot_begin_is_refused_before_the_profile_is_read(
    changes: dict[str, object], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("udccal.cli.jobs.live.keep_compilations", lambda: None)
    camera = LiveCamera("sim", None, None, None, 30.0, 0)
    wanted = LiveRun(
        Path("no-such-profile"),
        Tier.preview,
        camera,
        "shm:not-made",
        None,
        None,
        "cpu",
        None,
        1.0,
        Limits(frames=1),
        None,
    )
    with pytest.raises(UdccalError, match=message):
        run_live(Output(), replace(wanted, **changes))


def test_a_run_that_cannot_begin_leaves_its_log_as_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("udccal.cli.jobs.live.keep_compilations", lambda: None)
    (tmp_path / "earlier").write_text("earlier")
    for name in ("earlier", "new"):
        camera = LiveCamera("sim", None, None, None, 30.0, 0)
        limits, log = Limits(frames=1), tmp_path / name
        with pytest.raises(UdccalError, match="no-such-profile"):
            run_live(
                Output(),
                LiveRun(
                    Path("no-such-profile"), Tier.preview, camera, "shm:a", None, None, "cpu", None, 1.0, limits, log
                ),
            )
    assert [(file.name, file.read_text()) for file in tmp_path.iterdir()] == [("earlier", "earlier")]


def test_a_log_that_would_replace_what_the_run_reads_is_refused(
    profile_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("udccal.cli.jobs.live.keep_compilations", lambda: pytest.fail("worked"))
    panel, raw = tmp_path / "panel.png", write_raw_files(tmp_path / "raw", 1)
    panel.write_bytes(b"a picture")
    camera = LiveCamera("files", None, raw, 1e-3, 5.0, 0)
    wanted = LiveRun(profile_folder, Tier.fast, camera, "shm:a", panel, None, "cpu", None, 1.0, Limits(), None)
    before = {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()}
    for log, words in (
        (raw / "0.png", "apart from .*raw"),
        (raw / "new.jsonl", "apart from .*raw"),
        (panel, "apart from .*panel.png"),
        (profile_folder / "profile.json", "inside the profile"),
        (profile_folder / "log.jsonl", "inside the profile"),
    ):
        with pytest.raises(UdccalError, match=words):
            run_live(Output(), replace(wanted, log=log))
    for sink, words in (
        (f"images:{raw}", "apart from the frames"),
        (f"video:{raw}/a.mp4", "apart from the frames"),
        (f"video:{profile_folder}/a.mp4", "inside the profile"),
    ):
        with pytest.raises(UdccalError, match=words):
            run_live(Output(), replace(wanted, sink=sink))
    assert {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()} == before


@pytest.mark.parametrize(
    ("kind", "changes", "message"),
    [
        ("sim", {"mirror_delay_s": 0.02}, "--mirror with a camera that sees the panel, found --camera sim"),
        ("u3v", {"mirror_delay_s": 0.02, "panel_picture": Path("a.png")}, "one of --mirror and --panel-picture"),
        ("u3v", {"device": "gpu"}, "a tier that deblurs with --device gpu, found preview"),
    ],
)
def test_what_does_not_go_together_is_refused(kind: str, changes: dict[str, object], message: str) -> None:
    camera = LiveCamera(kind, None, None, None, 30.0, 0)
    wanted = LiveRun(Path("p"), Tier.preview, camera, "shm:not-made", None, None, "cpu", None, 1.0, Limits(), None)
    with pytest.raises(LiveError, match=message):
        replace(wanted, **changes)


def test_a_mirrors_sink_gets_mirror_images_of_what_the_camera_sees_on_the_panel(
    profile_folder: Path, live_rig: RigDescription, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("udccal.cli.jobs.live.keep_compilations", lambda: None)
    plug(CameraModel(columns=96, rows=64, cfa=live_rig.camera.cfa, bits=live_rig.camera.bits), Faults(), monkeypatch)
    seen: list[np.ndarray] = []
    monkeypatch.setattr(OwnPictures, "wrote", lambda own, picture, at_ns: seen.append(picture))
    camera, out = LiveCamera("u3v", None, None, 2e-3, 25.0, 0), tmp_path / "out"
    hook = "tests.live.test_command:marked"
    wanted = LiveRun(
        profile_folder, Tier.preview, camera, f"images:{out}", None, 0.02, "cpu", hook, 10.0, Limits(frames=3), None
    )
    run_live(Output(), wanted)
    shown = [read_rgb8(file) for file in sorted(out.iterdir())]
    assert len(shown) == len(seen) == 3
    for mirrored, picture in zip(shown, seen, strict=True):
        assert np.all(picture[0, 0] == (1, 2, 3))
        np.testing.assert_array_equal(mirrored, picture[:, ::-1])


def marked(picture: np.ndarray, frame_id: int) -> np.ndarray:
    picture[0, 0] = (1, 2, 3)
    return picture


def test_frames_without_their_panel_picture_are_counted(
    profile_folder: Path, live_rig: RigDescription, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("udccal.cli.jobs.live.keep_compilations", lambda: None)
    restores = Restorer.restore

    def refusing(self: Restorer, mosaic: np.ndarray, exposure_s: float, shown: np.ndarray | None = None) -> np.ndarray:
        if shown is not None and shown.any():
            raise PanelPictureError("Expected a frame at least as bright as the panel's own light.")
        return restores(self, mosaic, exposure_s, shown)

    monkeypatch.setattr(Restorer, "restore", refusing)
    shown = np.full((live_rig.panel.rows, live_rig.panel.columns, 3), 200, np.uint8)
    write_rgb8(tmp_path / "panel.png", shown)
    raw, log, out = write_raw_files(tmp_path / "raw", 3), tmp_path / "log.jsonl", tmp_path / "out"
    camera = LiveCamera("files", None, raw, 1e-3, 5.0, 0)
    panel = tmp_path / "panel.png"
    run_live(
        Output(),
        LiveRun(profile_folder, Tier.preview, camera, f"images:{out}", panel, None, "cpu", None, 1.0, Limits(), log),
    )
    whole = json.loads(log.read_text().splitlines()[-1])
    assert (whole["written"], whole["without_panel_picture"]) == (3, 1)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a file that is always full")
def test_a_full_disk_under_the_log_ends_no_run(
    profile_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("udccal.cli.jobs.live.keep_compilations", lambda: None)
    camera = LiveCamera("files", None, write_raw_files(tmp_path / "raw", 3), 1e-3, 2.0, 0)
    sink, log = f"images:{tmp_path / 'out'}", Path("/dev/full")
    run_live(
        Output(),
        LiveRun(profile_folder, Tier.preview, camera, sink, None, None, "cpu", None, 1.0, Limits(), log),
    )
    assert len(list((tmp_path / "out").iterdir())) == 3
    assert "The figures in /dev/full are cut short: it could not be written to." in capsys.readouterr().err


def test_signals_that_are_ignored_stay_so(monkeypatch: pytest.MonkeyPatch) -> None:
    """``nohup`` has SIGHUP ignored: the run goes on when its terminal closes."""
    stop = threading.Event()
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with _ended_by_signals(stop):
            os.kill(os.getpid(), signal.SIGHUP)
            assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
            assert not stop.is_set()
            os.kill(os.getpid(), signal.SIGTERM)
            assert stop.wait(10)
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_handlers_that_are_not_pythons_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[object] = []
    monkeypatch.setattr("signal.getsignal", lambda number: None)
    monkeypatch.setattr("signal.signal", lambda number, handler: asked.append(number))
    with _ended_by_signals(threading.Event()):
        pass
    assert not asked


def test_a_gpu_that_is_not_there_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("udccal.cli.jobs.live.keep_compilations", lambda: None)
    monkeypatch.setattr("jax.devices", lambda: jax.local_devices(backend="cpu"))
    camera = LiveCamera("u3v", None, None, None, 30.0, 0)
    wanted = LiveRun(Path("p"), Tier.fast, camera, "shm:not-made", None, None, "gpu", None, 1.0, Limits(), None)
    with pytest.raises(LiveError, match=r"a GPU that JAX can use, found none. .* leave --device out"):
        run_live(Output(), wanted)


def test_another_camera_is_refused_before_the_profile_is_prepared(
    profile_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("udccal.cli.jobs.live.keep_compilations", lambda: None)
    monkeypatch.setattr("udccal.cli.jobs.live.Restorer", None)
    write_png16(tmp_path / "small.png", np.full((32, 48), 900, np.uint16))
    camera = LiveCamera("files", None, tmp_path, 1e-3, 30.0, 0)
    wanted = LiveRun(
        profile_folder, Tier.fast, camera, "shm:not-made", None, None, "cpu", None, 1.0, Limits(frames=1), None
    )
    with pytest.raises(CameraError, match=r"a camera of 96 x 64.* found 48 x 32"):
        run_live(Output(), wanted)


def test_files_and_their_folder_go_together() -> None:
    for kind, files in (("files", None), ("sim", Path("folder"))):
        with pytest.raises(CameraError, match="--files"):
            LiveCamera(kind, None, files, None, 30.0, 0)


def test_frames_of_another_camera_end_it_with_a_sentence(profile_folder: Path, tmp_path: Path) -> None:
    write_png16(tmp_path / "small.png", np.full((32, 48), 900, np.uint16))
    words = ["--camera", "files", "--files", tmp_path, "--exposure-s", "0.001", "--sink", f"images:{tmp_path / 'out'}"]
    done = udccal_run("--profile", profile_folder, *words)
    assert done.returncode == 1
    assert "96 x 64" in json.loads(done.stdout)["error"]


@pytest.mark.slow
def test_the_simulated_camera_becomes_a_video(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    done = udccal_run("--profile", "lg55-reduced", "--sink", f"video:{path}", "--frames", "5")
    assert done.returncode == 0, done.stderr
    shown = json.loads(done.stdout)
    assert shown["written"] == 5
    assert shown["latency_ms"]["p50"] > 0
    video = cv2.VideoCapture(str(path))
    assert int(video.get(cv2.CAP_PROP_FRAME_COUNT)) >= 5
    picture = video.read()[1]
    assert picture.shape == (540, 960, 3)
    assert picture.std() > 10
