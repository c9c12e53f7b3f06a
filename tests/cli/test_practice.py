"""A calibration of a simulated rig by keys in a pseudo-terminal, with mistakes and an interruption."""

from __future__ import annotations

import json
import os
import pty
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.toy_rigs import change_rig, write_toy_rig
from udccal.sessions.store import Session

_TERMS = ("--term", "wire", "--term", "psf")
_PATIENCE_S = 400.0


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    """The toy rig with two cells of a small field."""
    rig = write_toy_rig(tmp_path)
    few = {"psf_columns = 3": "psf_columns = 2", "psf_rows = 3": "psf_rows = 1", "psf_shifts = 3": "psf_shifts = 2"}
    change_rig(
        rig,
        few
        | {"pitch_um = 55.2": "pitch_um = 6.9", "psf_exposures = 6": "psf_exposures = 3", "flats = 100": "flats = 16"},
    )
    return rig


def command(rig: Path, folder: Path, *words: str) -> list[str]:
    places = ["--rig", str(rig), "--session", str(folder / "s"), "--profile", str(folder / "p")]
    return [sys.executable, "-m", "udccal.cli.main", "calibrate", *places, "--practice", *_TERMS, *words]


class Terminal:
    """A program in a pseudo-terminal, by keys."""

    def __init__(self, words: list[str]) -> None:
        self._keys, theirs = pty.openpty()
        self.process = subprocess.Popen(
            words,
            stdin=theirs,
            stdout=theirs,
            stderr=theirs,
            start_new_session=True,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        )
        os.close(theirs)
        os.set_blocking(self._keys, False)
        self.shown = ""
        self._read = 0

    def until(self, words: str) -> None:
        """Wait until the words are shown, after those waited for before."""
        self._wait(lambda: words in self.shown[self._read :], words)
        self._read = self.shown.index(words, self._read) + len(words)

    def type(self, line: str = "") -> None:
        os.write(self._keys, f"{line}\n".encode())

    def stop(self) -> int:
        """Press Ctrl-C, and return the exit status."""
        os.killpg(self.process.pid, signal.SIGINT)
        return self.ended()

    def ended(self) -> int:
        self._wait(lambda: self.process.poll() is not None, "the end")
        return self.process.returncode

    def _wait(self, there: Callable[[], bool], what: str) -> None:
        until = time.monotonic() + _PATIENCE_S
        while not there():
            assert time.monotonic() < until, f"waited for {what!r}, found: {self.shown[-2000:]}"
            try:
                self.shown += os.read(self._keys, 65536).decode(errors="replace").replace("\r\n", "\n")
            except (BlockingIOError, OSError):
                assert self.process.poll() is None or there(), f"ended before {what!r}: {self.shown[-2000:]}"
                time.sleep(0.05)


@pytest.mark.slow
def test_a_practice_by_keys_gives_the_session_that_no_mistake_has_touched(rig: Path, tmp_path: Path) -> None:
    (tmp_path / "plain").mkdir()
    plain = Terminal(command(rig, tmp_path / "plain", "--yes", "--json-events"))
    plain.until('"event": "done"}')
    plain.stop()
    told = [json.loads(line) for line in plain.shown.splitlines() if line.startswith('{"')]
    assert {event["event"] for event in told} == {"step", "readings", "progress", "verdict", "done"}
    assert told[-1]["complete"]
    readings = [reading for event in told if event["event"] == "readings" for reading in event["readings"]]
    assert {reading["ok"] for reading in readings} <= {True, False}
    assert len(readings) > 0

    first = Terminal(command(rig, tmp_path))
    first.until("Step 1 of 4")
    first.until("Enter · skip · back · quit · wrong")
    first.type("jump")
    first.until("'jump' is none of the answers: Enter, skip, back, quit, wrong.")
    first.type("wrong")
    first.until("Little light is seen")
    first.type()
    first.until("✗ Step wire/flat: Expected to see the light")
    first.type()  # tries again
    first.until("evenness")
    first.type("skip")
    first.until("This step takes up the exposure of wire/flat, which was not captured.")
    first.type("back")
    first.until("Step 1 of 4")
    first.until("Enter · skip · back · quit · wrong")
    first.type()
    first.until("✓ Even light for the wire")
    assert first.stop() == 130
    assert "Stopped. Run the same command again" in first.shown.replace("\n", " ")
    assert "Traceback" not in first.shown

    second = Terminal(command(rig, tmp_path))
    second.until("Step 2 of 4")
    second.until("Enter · skip · back · quit · wrong")
    second.type()
    second.until("✓ Darkness for the wire")
    second.type()
    second.until("Step 3 of 4")
    second.type("wrong")
    second.until("Move the LED so that its image goes")
    second.type("again")
    second.until("✓ LED in cell 1 of 2")
    second.until("✓ LED in cell 2 of 2")
    second.until("Everything is captured.")
    second.stop()  # the fits are no part of this test

    one, other = (Session.open(folder / "s") for folder in (tmp_path / "plain", tmp_path))
    assert [step.id for step in one.manifest.steps] == [step.id for step in other.manifest.steps]
    for mine, theirs in zip(one.manifest.steps, other.manifest.steps, strict=True):
        assert mine.subject == theirs.subject
        assert [capture.sha256 for capture in mine.captures] == [capture.sha256 for capture in theirs.captures]


@pytest.mark.medium
def test_quit_leaves_with_130_and_fits_nothing(rig: Path, tmp_path: Path) -> None:
    terminal = Terminal(command(rig, tmp_path))
    terminal.until("Enter · skip · back · quit · wrong")
    terminal.type("quit")
    assert terminal.ended() == 130
    assert not (tmp_path / "p").exists()


@pytest.mark.parametrize(
    "words", [["--practice", "--camera", "files"], ["--yes"], ["--json-events", "--camera", "files"]], ids=str
)
def test_words_that_do_not_go_together_are_refused(words: list[str], rig: Path, tmp_path: Path) -> None:
    places = ["--rig", str(rig), "--session", str(tmp_path / "s"), "--profile", str(tmp_path / "p")]
    done = subprocess.run(
        [sys.executable, "-m", "udccal.cli.main", "calibrate", *places, *words],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 2
    assert not (tmp_path / "s").exists()


def test_nobody_at_the_keys_is_said(rig: Path, tmp_path: Path) -> None:
    done = subprocess.run(command(rig, tmp_path), stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=200)
    assert done.returncode == 1
    assert "Expected a person to answer, found that standard input is closed." in done.stderr.replace("\n", " ")


@pytest.mark.slow
def test_what_is_skipped_is_said_in_fit_report_and_profile(rig: Path, tmp_path: Path) -> None:
    """Of noise and wire the darkness is skipped, of the psf one cell of two."""
    captured, skipped = "\n\n", "skip\n"
    words = [*command(rig, tmp_path), "--term", "noise", "--json"]
    typed = captured + skipped + captured + skipped + skipped
    done = subprocess.run(words, input=typed, capture_output=True, text=True, timeout=_PATIENCE_S)
    assert done.returncode == 0, done.stderr
    assert "Captured, without noise/dark_stack, wire/dark, psf/p00." in done.stderr.replace("\n", " ")
    darks = ", ".join(f"noise/dark_{index}" for index in range(5))
    notes = {
        "noise": [
            "Captured in part: the fit needs 2 more exposures in the dark as well.",
            f"6 of 15 planned steps captured, without noise/dark_stack, {darks} and 3 more.",
        ],
        "wire": [
            "Captured in part: the fit needs wire/dark as well.",
            "1 of 2 planned steps captured, without wire/dark.",
        ],
        "psf": [
            "Captured in part: the fit needs 2 more places of the LED as well.",
            "2 of 4 planned steps captured, without psf/p00_s0, psf/p00_s1.",
        ],
    }
    report = (tmp_path / "p-report.html").read_text(encoding="utf-8")
    show = subprocess.run(
        [sys.executable, "-m", "udccal.cli.main", "profile", "show", str(tmp_path / "p"), "--json"],
        capture_output=True,
        text=True,
        timeout=_PATIENCE_S,
    )
    for terms in (json.loads(done.stdout)["terms"], json.loads(show.stdout)["terms"]):
        assert {term["term"]: term["status"] for term in terms} == dict.fromkeys(
            ("noise", "geometry", "wire", "psf", "backscatter"), "NOT_CAPTURED"
        )
        assert {term["term"]: term["notes"] for term in terms if term["notes"]} == notes
    for note in (note for of_term in notes.values() for note in of_term):
        assert note in report


def practised(rig: Path, folder: Path, typed: str) -> tuple[int, str]:
    """The status, and what was said, without the breaks of lines."""
    words = command(rig, folder, "--term", "wire")
    done = subprocess.run(words, input=typed, capture_output=True, text=True, timeout=_PATIENCE_S)
    assert "Traceback" not in done.stderr
    return done.returncode, " ".join(done.stderr.split())


@pytest.mark.slow
def test_two_at_once_do_not_share_a_session(rig: Path, tmp_path: Path) -> None:
    folder = tmp_path / "à 用户 'x'"
    folder.mkdir()
    first = Terminal(command(rig, folder))
    first.until("Enter · skip · back · quit · wrong")
    status, said = practised(rig, folder, "\n")
    assert status == 1
    assert "to be free, found that another process is writing to it." in said, said
    first.type("quit")
    assert first.ended() == 130


@pytest.mark.slow
def test_a_full_disk_ends_a_practice_with_a_sentence_and_a_session_to_go_on_with(rig: Path, tmp_path: Path) -> None:
    disk = tmp_path / "disk µ"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=64k", "udccal-test", str(disk)]
    if shutil.which("mount") is None or subprocess.run(mount, capture_output=True).returncode != 0:
        pytest.skip("needs the right to mount a small file system")
    try:
        status, said = practised(rig, disk, "\n\n")
        assert status == 1
        assert "No space left on device" in said
        assert not list(disk.rglob("*.partial*"))
        assert not (disk / "p").exists()
        assert Session.open(disk / "s").steps("wire") == ()
    finally:
        subprocess.run(["umount", str(disk)], check=True)
