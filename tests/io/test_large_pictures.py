"""Small files that unpack to huge pictures are refused by their header, in every place that reads pictures."""

from __future__ import annotations

import struct
import time
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from udccal.cameras.picture_files.mosaics import Layout, read_mosaic
from udccal.cameras.protocol import CameraIdentity, Frame, Region, Settings
from udccal.cli.jobs.explain import _checked_frame
from udccal.cli.jobs.panel_picture import read_panel_picture
from udccal.errors import FileFormatError, ProfileError, SessionError
from udccal.io.exr import read_exr, read_rgb_exr, write_exr
from udccal.io.hashing import sha256_file
from udccal.io.photograph import read_photograph
from udccal.io.png import read_png16, write_png16
from udccal.profiles.arrays import load, read_checked
from udccal.profiles.schema import StoredArray
from udccal.profiles.store import load_profile
from udccal.sessions.captured import SingleFrame
from udccal.sessions.schema import DarkSubject, PanelSubject
from udccal.sessions.store import Session
from udccal.sessions.writer import SessionWriter

PROFILE = load_profile("lg55-reduced")
RIG = PROFILE.rig
SIDE = 16384


def huge_png(path: Path, bits: int, colour: int, side: int = SIDE) -> Path:
    """A whole PNG of zeros, made without its rows: a megabyte of zeros, packed once and repeated."""
    channels = 3 if colour == 2 else 1
    total = side * (1 + side * channels * bits // 8)
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    piece = packer.compress(bytes(1 << 20)) + packer.flush(zlib.Z_FULL_FLUSH)
    last = zlib.compressobj(9, zlib.DEFLATED, -15)
    end = last.compress(bytes(total % (1 << 20))) + last.flush()
    # Adler-32 of zeros: one sum stays 1, the other counts them.
    stream = b"\x78\x9c" + piece * (total >> 20) + end + struct.pack(">I", total % 65521 << 16 | 1)
    header = struct.pack(">IIBBBBB", side, side, bits, colour, 0, 0, 0)
    with path.open("wb") as file:
        file.write(b"\x89PNG\r\n\x1a\n")
        for kind, content in ((b"IHDR", header), (b"IDAT", stream), (b"IEND", b"")):
            file.write(struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content)))
    assert path.stat().st_size < 1 << 21
    return path


def exr_that_claims(path: Path, side: int, *names: str) -> Path:
    write_exr(path, dict.fromkeys(names, np.zeros((4, 4))))
    content = bytearray(path.read_bytes())
    place = content.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4
    content[place : place + 16] = struct.pack("<4i", 0, 0, side - 1, side - 1)
    path.write_bytes(content)
    return path


def stored_session(folder: Path, name: str, change: Callable[[Path], object]) -> Session:
    """A session with one frame, whose file was exchanged, checksum and all."""
    frame = SingleFrame(Frame(np.zeros((8, 8), np.uint16), Settings(0.01, 0.0, Region(0, 0, 8, 8)), 0.0, 0, True))
    with SessionWriter.create(folder, RIG, CameraIdentity("a", "b", "c", "d")) as writer:
        writer.add_step("noise/dark_0", "noise", DarkSubject(), [frame])
    before = sha256_file(folder / "noise/dark_0_0.png")
    change(folder / name)
    manifest = (folder / "session.json").read_text().replace(before, sha256_file(folder / "noise/dark_0_0.png"))
    seal = manifest.index('"manifest_sha256"')
    (folder / "session.json").write_text(manifest[:seal] + manifest[manifest.index("\n", seal) + 1 :])
    return Session.open(folder)


@pytest.fixture(autouse=True)
def undecoded(monkeypatch: pytest.MonkeyPatch) -> None:
    """No decoder is asked for samples, and hardly any time is spent."""

    def refuse(*arguments: object) -> None:
        raise AssertionError("a decoder was asked")

    monkeypatch.setattr(cv2, "imdecode", refuse)
    monkeypatch.setattr("udccal.io.exr._plane", refuse)


def refused(error: type[Exception], read: Callable[[], object], found: str = f"{SIDE} x {SIDE}") -> None:
    start = time.process_time()
    with pytest.raises(error, match=f"Expected .* found:? {found}"):
        read()
    assert time.process_time() - start < 0.5


def test_the_picture_is_whole_but_for_its_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    assert not read_png16(huge_png(tmp_path / "a.png", 16, 0, 1200)).any()


def test_frames_to_restore(tmp_path: Path) -> None:
    refused(FileFormatError, lambda: _checked_frame(huge_png(tmp_path / "a.png", 16, 0), 0.01, PROFILE))
    refused(FileFormatError, lambda: _checked_frame(huge_png(tmp_path / "b.png", 16, 0, 4096), 0.01, PROFILE), "4096 x")


def test_panel_pictures(tmp_path: Path) -> None:
    refused(FileFormatError, lambda: read_panel_picture(huge_png(tmp_path / "a.png", 8, 2, 4096), RIG), "4096 x")


def test_frames_and_pictures_of_a_session(tmp_path: Path) -> None:
    session = stored_session(tmp_path / "s", "noise/dark_0_0.png", lambda file: huge_png(file, 16, 0, 4096))
    refused(SessionError, lambda: session.frame(session.step("noise/dark_0").captures[0]), "4096 x 4096")
    shown = huge_png(tmp_path / "s" / "shown.png", 8, 2, 4096)
    subject = PanelSubject(picture="shown.png", picture_sha256=sha256_file(shown), role="white")
    refused(SessionError, lambda: session.picture(subject), "4096 x 4096")


def test_photographs_and_mosaics_of_no_known_size(tmp_path: Path) -> None:
    refused(FileFormatError, lambda: read_photograph(huge_png(tmp_path / "a.png", 8, 2)))
    refused(FileFormatError, lambda: read_photograph(huge_png(tmp_path / "a.png", 8, 0)))
    refused(FileFormatError, lambda: read_mosaic(huge_png(tmp_path / "a.png", 16, 0), Layout("RGGB", 12)))
    refused(FileFormatError, lambda: read_rgb_exr(exr_that_claims(tmp_path / "a.exr", SIDE, *"RGB")))


def test_pictures_and_arrays_of_a_profile(tmp_path: Path) -> None:
    file = exr_that_claims(tmp_path / "a.exr", SIDE, "value")
    array = StoredArray(name="a", file="a.exr", sha256=sha256_file(file), dtype="float64", shape=(2, 3, 8), unit="1")
    refused(ProfileError, lambda: load(tmp_path, array))
    refused(ProfileError, lambda: read_checked(tmp_path, "a.exr", sha256_file(file)))
    file = exr_that_claims(tmp_path / "a.exr", 4096, "wire")
    refused(ProfileError, lambda: read_checked(tmp_path, "a.exr", sha256_file(file), (64, 96)), "4096 x 4096")


def test_many_channels_of_the_right_size(tmp_path: Path) -> None:
    write_exr(tmp_path / "a.exr", {f"c{index}": np.zeros((4, 4)) for index in range(4)})
    refused(FileFormatError, lambda: read_exr(tmp_path / "a.exr", (4, 4)), "4 channels")


def test_the_largest_sensors_are_not_refused(tmp_path: Path) -> None:
    write_png16(tmp_path / "a.png", np.zeros((4, 4), np.uint16))
    content = bytearray((tmp_path / "a.png").read_bytes())
    content[16:24] = struct.pack(">II", 14204, 10652)
    (tmp_path / "a.png").write_bytes(content)
    with pytest.raises(FileFormatError, match="damaged data"):  # its checksum, which is looked at afterwards
        read_png16(tmp_path / "a.png")
