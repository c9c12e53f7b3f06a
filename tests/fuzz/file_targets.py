"""Readers of sessions and pictures."""

from __future__ import annotations

import contextlib
import json
import tempfile
from pathlib import Path

import cv2
import numpy as np

from tests.cameras.small_tiff import grey_entries, write_dng, write_tiff
from tests.fuzz.target import Target, of_file, written
from udccal.cameras.picture_files.facts import read_facts
from udccal.cameras.picture_files.mosaics import read_raw
from udccal.cameras.picture_files.sidecar import list_folder
from udccal.cameras.picture_files.tiff import read_tiff16
from udccal.cameras.protocol import CameraIdentity, Frame, Region, Settings
from udccal.errors import SessionError
from udccal.io.exr import read_exr, write_exr
from udccal.io.photograph import read_photograph
from udccal.io.png import read_png16, read_rgb8, write_png16, write_rgb8
from udccal.rig import load_rig
from udccal.sessions.captured import AveragedFrames, SingleFrame
from udccal.sessions.schema import DarkSubject, FlatSubject, LedSubject
from udccal.sessions.store import Session
from udccal.sessions.writer import SessionWriter

_MOSAIC = np.arange(12 * 8, dtype=np.uint16).reshape(8, 12)
_LARGER = np.arange(64 * 48, dtype=np.uint16).reshape(48, 64)  # LibRaw wants no smaller ones
_RGB = np.arange(6 * 5 * 3, dtype=np.uint8).reshape(6, 5, 3)
_SMOOTH = np.linspace(0, 255, 16 * 20 * 3).reshape(16, 20, 3).astype(np.uint8)
_PLANES = {"mean": np.linspace(60, 70, 24).reshape(4, 6), "variance": np.full((4, 6), 3.0)}


_SIDECAR = b"file,exposure_s,gain_dB\na.png,0.01,0\nb.png,0.02,6.0\n"


def _tiff() -> bytes:
    return written("a.tif", lambda path: write_tiff(path, grey_entries(_MOSAIC), _MOSAIC.tobytes()))


def _dng() -> bytes:
    return written("a.dng", lambda path: write_dng(path, _LARGER))


def _raw(path: Path) -> None:
    read_facts(path)
    read_raw(path)


def _list(path: Path) -> None:
    for name in ("a.png", "b.png"):
        (path.parent / name).touch()
    list_folder(path.parent)


def _manifest(folder: Path) -> bytes:
    frame = Frame(_MOSAIC, Settings(0.01, 0.0, Region(0, 0, 12, 8)), 0.0, 0, True)
    mean, variance = (_PLANES[name].astype(np.float32) for name in ("mean", "variance"))
    average = AveragedFrames(mean, variance, 8, Settings(0.01, 0.0, Region(2, 4, 6, 4)), 1.0, 2.0)
    led = LedSubject(x_px=3.0, y_px=4.0, distance_mm=2000.0, diameter_mm=2.0)
    with SessionWriter.create(folder, load_rig("lg55-reduced"), CameraIdentity("a", "b", "c", "d")) as writer:
        writer.add_step("noise/dark_0", "noise", DarkSubject(), [SingleFrame(frame), SingleFrame(frame)])
        writer.add_step("wire/flat", "wire", FlatSubject(), [average])
        writer.add_step("psf/p00_s0", "psf", led, [SingleFrame(frame)])
    content = json.loads((folder / "session.json").read_text())
    del content["manifest_sha256"]  # a changed byte has to get past it to the rest
    return json.dumps(content).encode()


def _manifests() -> tuple[bytes, ...]:
    with tempfile.TemporaryDirectory(prefix="udccal-fuzz-") as folder:
        sealless = _manifest(Path(folder) / "session")
        sealed = (Path(folder) / "session" / "session.json").read_bytes()
    return (sealless, sealed)


def _open_session(path: Path) -> None:
    """Everything that is read of a session, its pictures and averages too, which are never there."""
    session = Session.open(path.parent)
    for capture in (capture for step in session.manifest.steps for capture in step.captures):
        with contextlib.suppress(SessionError):
            session.frame(capture) if capture.kind == "frame" else session.average(capture)


FILE_TARGETS = (
    Target("session", of_file("session.json", _open_session), _manifests, 16384),
    Target("png16", of_file("a.png", read_png16), lambda: (written("a.png", lambda path: write_png16(path, _MOSAIC)),)),
    Target("rgb8", of_file("a.png", read_rgb8), lambda: (written("a.png", lambda path: write_rgb8(path, _RGB)),)),
    Target("tiff", of_file("a.tif", read_tiff16), lambda: (_tiff(),), 2048),
    Target("raw", of_file("a.dng", _raw), lambda: (_dng(),), 8192),
    Target("sidecar", of_file("frames.csv", _list), lambda: (_SIDECAR,), 1024),
    Target("exr", of_file("a.exr", read_exr), lambda: (written("a.exr", lambda path: write_exr(path, _PLANES)),)),
    Target(
        "photograph",
        of_file("a.jpg", read_photograph),
        lambda: (
            written("a.png", lambda path: write_rgb8(path, _RGB)),
            written("a.jpg", lambda path: cv2.imwrite(str(path), _SMOOTH)),
            written("a.hdr", lambda path: cv2.imwrite(str(path), _SMOOTH.astype(np.float32))),
        ),
    ),
)
