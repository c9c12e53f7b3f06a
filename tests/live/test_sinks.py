"""Sinks that write files, and those that this computer may not have."""

from __future__ import annotations

import sys
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from tests.live.conftest import COLUMNS, ROWS, restored_frame
from tests.live.test_pipeline import ListSink
from udccal import plugins
from udccal.errors import LiveError, ProfileError, UdccalError
from udccal.io.png import read_rgb8
from udccal.live.sinks.images import ImagesSink
from udccal.live.sinks.mirrored import MirroredSink
from udccal.live.sinks.protocol import RestoredFrame, Sink, make_sink
from udccal.live.sinks.shared_memory import SharedMemorySink
from udccal.live.sinks.video import VideoSink
from udccal.live.sinks.virtual_camera import VirtualCameraSink
from udccal.live.sinks.window import WindowSink


def test_sinks_are_found_by_name() -> None:
    for text, kind in (("shm:a", SharedMemorySink), ("images:some:folder", ImagesSink)):
        sink = make_sink(text, 30.0)
        assert isinstance(sink, kind)
        assert isinstance(sink, Sink)
    with pytest.raises(UdccalError, match=r"sink 'vidoe', found none .* which has images, shm, v4l2, video, window"):
        make_sink("vidoe:x.mp4", 30.0)


def test_another_packages_sink_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    mine = EntryPoint("mine", "tests.live.test_pipeline:ListSink", plugins.SINKS)
    monkeypatch.setattr(plugins, "_installed", lambda group: EntryPoints([mine]).select(group=group))
    sink = make_sink("mine:3", 30.0)
    assert isinstance(sink, ListSink)
    assert sink.fails_at == 3


def test_images_are_whole_files_named_by_their_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sink = ImagesSink(str(tmp_path / "new" / "folder"), 30.0)
    sink.open((ROWS, COLUMNS))
    sink.write(restored_frame(2))

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="No space"):
        sink.write(restored_frame(3))
    sink.close()
    (file,) = (tmp_path / "new" / "folder").iterdir()
    assert file.name == "frame-00000002.png"
    assert np.all(read_rgb8(file) == 2)


@pytest.mark.parametrize("text", ["images:/proc/none", "images:{0}/file/folder", "images:" + "x" * 300])
def test_a_folder_that_cannot_be_written_is_refused_before_a_run(tmp_path: Path, text: str) -> None:
    (tmp_path / "file").write_bytes(b"mine")
    with pytest.raises(UdccalError, match=r"Expected to write the results to .* found: "):
        make_sink(text.format(tmp_path), 30.0)


def test_a_video_that_cannot_be_written_is_refused_before_a_run(tmp_path: Path) -> None:
    (tmp_path / "a.mp4").mkdir()
    with pytest.raises(LiveError, match=r"video:FILE\.mp4 in a folder that exists"):
        make_sink(f"video:{tmp_path / 'a.mp4'}", 30.0)
    with pytest.raises(UdccalError, match="Expected to write the results to /proc"):
        make_sink("video:/proc/a.mp4", 30.0)


@pytest.mark.parametrize("rate_hz", [0.0, -1.0, float("nan"), float("inf")])
def test_frames_have_a_rate(tmp_path: Path, rate_hz: float) -> None:
    with pytest.raises(LiveError, match="a rate of frames in Hz"):
        make_sink(f"video:{tmp_path / 'a.mp4'}", rate_hz)


def test_a_folder_with_files_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"mine")
    for wrong in (tmp_path, tmp_path / "file", ""):
        with pytest.raises(LiveError, match="new or empty"):
            ImagesSink(str(wrong), 30.0)


def test_a_place_in_a_profile_is_refused(tmp_path: Path) -> None:
    (tmp_path / "profile.json").write_text("{}")
    for text in (f"images:{tmp_path / 'sub'}", f"video:{tmp_path / 'a.mp4'}"):
        with pytest.raises(ProfileError, match="inside the profile"):
            make_sink(text, 30.0)
    assert [file.name for file in tmp_path.iterdir()] == ["profile.json"]


def test_a_video_has_its_name_when_it_is_whole_and_lasts_as_long_as_the_run(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    path.write_bytes(b"an earlier one")
    sink = VideoSink(str(path), 10.0)
    sink.open((ROWS, COLUMNS))
    for number, at_s in ((100, 5.0), (110, 5.1), (140, 5.4), (150, 5.5)):  # two were dropped
        sink.write(restored_frame(number, at_s=at_s))
        assert path.read_bytes() == b"an earlier one"
    sink.close()
    assert [item.name for item in tmp_path.iterdir()] == ["a.mp4"]
    video = cv2.VideoCapture(str(path))
    levels = [round(float(video.read()[1].mean())) for _ in range(6)]
    assert not video.read()[0]
    assert levels == pytest.approx([100, 110, 110, 110, 140, 150], abs=6)  # the codec's own error


def test_a_video_of_odd_size_keeps_its_colours(tmp_path: Path) -> None:
    sink = VideoSink(str(tmp_path / "a.mp4"), 10.0)
    sink.open((35, 63))
    frame = restored_frame(0, 35, 63)
    frame.picture[:] = (200, 100, 50)
    sink.write(frame)
    sink.close()
    read = cv2.VideoCapture(str(tmp_path / "a.mp4")).read()[1]
    assert read[..., ::-1].mean(axis=(0, 1)) == pytest.approx([200, 100, 50], abs=6)


def test_a_video_that_is_not_whole_leaves_what_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.mp4"
    path.write_bytes(b"an earlier one")
    empty = VideoSink(str(path), 10.0)
    empty.open((ROWS, COLUMNS))
    with pytest.raises(LiveError, match="hold 0 frames"):
        empty.close()
    cut = VideoSink(str(path), 10.0)
    cut.open((ROWS, COLUMNS))
    for number in range(3):
        cut.write(restored_frame(number, at_s=number / 10))
    monkeypatch.setattr("udccal.live.sinks.video._frames", lambda path: 2)
    with pytest.raises(LiveError, match="hold 3 frames, found 2"):
        cut.close()
    assert [(item.name, item.read_bytes()) for item in tmp_path.iterdir()] == [("a.mp4", b"an earlier one")]


def test_video_names_are_checked_first(tmp_path: Path) -> None:
    for wrong in ("", str(tmp_path / "a.avi"), str(tmp_path / "none" / "a.mp4")):
        with pytest.raises(LiveError, match=r"video:FILE\.mp4"):
            VideoSink(wrong, 30.0)


def test_a_window_needs_its_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(LiveError, match=r"pip install 'udccal\[window\]'"):
        WindowSink("", 30.0)


def test_a_virtual_camera_needs_its_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyvirtualcam", None)
    with pytest.raises(LiveError, match=r"pip install 'udccal\[v4l2\]'"):
        VirtualCameraSink("/dev/video7", 30.0)
    with pytest.raises(LiveError, match="v4l2:/dev/videoN, found 'video7'"):
        VirtualCameraSink("video7", 30.0)


def test_a_virtual_camera_gets_its_format_before_its_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[object] = []

    class Camera:
        def __init__(self, width: int, height: int, fps: float, *, device: str, fmt: object) -> None:
            calls.append((width, height, fps, device, fmt))
            if device == "/dev/video9":
                raise RuntimeError("no such device")

        def send(self, picture: np.ndarray) -> None:
            calls.append(picture.shape)

        def close(self) -> None:
            calls.append("close")

    library = SimpleNamespace(Camera=Camera, PixelFormat=SimpleNamespace(RGB="rgb"))
    monkeypatch.setattr("udccal.live.sinks.virtual_camera._library", lambda: library)
    with pytest.raises(LiveError, match="a virtual camera at /dev/video7 that may be written to, found none"):
        VirtualCameraSink("/dev/video7", 30.0)
    monkeypatch.setattr("os.access", lambda path, mode: True)
    sink = VirtualCameraSink("/dev/video7", 30.0)
    sink.open((ROWS, COLUMNS))
    sink.write(restored_frame(0))
    sink.close()
    assert calls == [(COLUMNS, ROWS, 30.0, "/dev/video7", "rgb"), (ROWS, COLUMNS, 3), "close"]
    absent = VirtualCameraSink("/dev/video9", 30.0)
    with pytest.raises(LiveError, match=r"no such device.* v4l2loopback"):
        absent.open((ROWS, COLUMNS))
    absent.close()


def test_a_mirrored_sink_gets_pictures_with_left_and_right_exchanged() -> None:
    sink = ListSink()
    mirrored: Sink = MirroredSink(sink)
    picture = np.arange(4 * 6 * 3, dtype=np.uint8).reshape(4, 6, 3)
    mirrored.open((4, 6))
    mirrored.write(RestoredFrame(picture, 7, 9))
    mirrored.close()
    assert sink.calls == ["open", "close"]
    (got,) = sink.frames
    assert (got.frame_id, got.captured_ns) == (7, 9)
    assert got.picture.flags.c_contiguous
    np.testing.assert_array_equal(got.picture, picture[:, ::-1])


def test_a_video_that_cannot_be_begun_leaves_nothing_and_ends_in_peace(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a.mp4").write_bytes(b"an earlier one")
    sink = VideoSink(str(tmp_path / "a.mp4"), 10.0)
    monkeypatch.setattr(cv2.VideoWriter, "isOpened", lambda writer: False)
    with pytest.raises(LiveError, match="Expected OpenCV to write"):
        sink.open((ROWS, COLUMNS))
    sink.close()
    assert [(item.name, item.read_bytes()) for item in tmp_path.iterdir()] == [("a.mp4", b"an earlier one")]
