from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from udccal.cameras.protocol import CameraIdentity, Frame, Region, Settings
from udccal.errors import SessionError
from udccal.rig import load_rig
from udccal.sessions.captured import AveragedFrames, SingleFrame
from udccal.sessions.schema import DarkSubject, FlatSubject
from udccal.sessions.store import Session
from udccal.sessions.writer import SessionWriter

RIG = load_rig("lg55-reduced")
SIZE_KIB = 300
WHOLE = Region(0, 0, 128, 128)


@pytest.fixture
def small_disk(disk: Callable[[str], Path]) -> Path:
    """A file system of 300 KiB."""
    return disk(f"size={SIZE_KIB}k")


def _add_steps(writer: SessionWriter, flat: AveragedFrames, count: int) -> None:
    for index in range(count):
        writer.add_step(f"wire/flat_{index}", "wire", FlatSubject(), [flat])


def test_a_disk_that_fills_up_costs_the_step_in_hand_only(small_disk: Path) -> None:
    dark = Frame(np.zeros((128, 128), np.uint16), Settings(1.0, 0.0, WHOLE), 0.0, 0, True)
    mean, variance = np.random.default_rng(0).uniform(0, 4000, (2, 128, 128)).astype(np.float32)
    flat = AveragedFrames(mean, variance, 16, Settings(1.0, 0.0, WHOLE), 0.0, 1.0)
    for filled_kib in range(0, SIZE_KIB - 40, 20):
        folder = small_disk / "session"
        with SessionWriter.create(folder, RIG, CameraIdentity("a", "b", "c", "test")) as writer:
            writer.add_step("noise/dark_0", "noise", DarkSubject(), [SingleFrame(dark)])
            (small_disk / "other").write_bytes(b"x" * (1024 * filled_kib))
            with pytest.raises(SessionError, match=r"No space left on device\. Free some space there"):
                _add_steps(writer, flat, SIZE_KIB // 100)
        assert not list(folder.rglob("*.partial*"))
        (small_disk / "other").unlink()
        with SessionWriter.resume(folder) as writer:
            assert writer.damage == ()
            assert "noise/dark_0" in writer.completed_ids
            if "wire/flat_0" not in writer.completed_ids:
                writer.add_step("wire/flat_0", "wire", FlatSubject(), [flat])
        session = Session.open(folder)
        for step in session.steps("wire"):
            np.testing.assert_array_equal(session.average(step.captures[0]).mean, mean)
        shutil.rmtree(folder)
