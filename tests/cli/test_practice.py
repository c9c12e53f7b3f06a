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

import numpy as np
import pytest

from tests.ctrl_c import heeding_ctrl_c
from tests.toy_rigs import change_rig, write_five_term_rig, write_toy_rig
from udccal.benches.capture import TERMS
from udccal.sessions.schema import LedSubject
from udccal.sessions.store import Session

_TERMS = ("--term", "wire", "--term", "psf")
_PATIENCE_S = 400.0
_WAITS = "Enter · skip · back · quit · wrong"


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


def command(rig: Path, folder: Path, *words: str, terms: tuple[str, ...] = _TERMS) -> list[str]:
    places = ["--rig", str(rig), "--session", str(folder / "s"), "--profile", str(folder / "p")]
    return [sys.executable, "-m", "udccal.cli.main", "calibrate", *places, "--practice", *terms, *words]


class Terminal:
    """A program in a pseudo-terminal, by keys; it does not outlive its test."""

    def __init__(self, words: list[str]) -> None:
        self._keys, theirs = pty.openpty()
        self.process = subprocess.Popen(
            words,
            stdin=theirs,
            stdout=theirs,
            stderr=theirs,
            start_new_session=True,
            preexec_fn=heeding_ctrl_c,
        )
        os.close(theirs)
        os.set_blocking(self._keys, False)
        self.shown = ""
        self._read = 0

    def __enter__(self) -> Terminal:
        return self

    def __exit__(self, *error: object) -> None:
        if self.process.poll() is None:
            os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait()
        os.close(self._keys)

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


def five_terms(rig: Path, folder: Path, *words: str) -> Terminal:
    return Terminal(command(rig, folder, *words, terms=()))


def undisturbed(rig: Path, folder: Path) -> None:
    """Capture every step by ``--yes``, and read what is written for programs."""
    with five_terms(rig, folder, "--yes", "--json-events") as plain:
        plain.until('"event": "done"}')
        plain.stop()  # the fits are no part of this test
    # After the last event, it may be read already that the program was stopped.
    told = [json.loads(line) for line in plain.shown.splitlines() if line.startswith('{"') and '"event"' in line]
    assert {event["event"] for event in told} == {"step", "readings", "progress", "verdict", "done"}
    assert told[-1]["complete"]
    readings = [reading for event in told if event["event"] == "readings" for reading in event["readings"]]
    assert {reading["ok"] for reading in readings} == {True, False}


def take(terminal: Terminal, step: int, title: str) -> None:
    """Capture a step that waits for Enter, and go on."""
    terminal.until(f"Step {step} of 10")
    terminal.until(_WAITS)
    terminal.type()
    terminal.until(f"✓ {title}")
    terminal.type()


def do_wrong_at_first(terminal: Terminal) -> None:
    """Mistype, capture nothing of no light, skip what the next step needs, come back, and stop amid the boards."""
    terminal.until("Step 1 of 10")
    terminal.until(_WAITS)
    terminal.type("jump")
    terminal.until("'jump' is none of the answers: Enter, skip, back, quit, wrong.")
    terminal.type("wrong")
    terminal.until("Little light is seen")
    terminal.type()
    terminal.until("✗ Step noise/flat_stack: Expected")
    terminal.type()  # tries again
    terminal.until("evenness")
    terminal.type("skip")
    terminal.until("This step takes up the exposure of noise/flat_stack, which was not captured.")
    terminal.type("back")
    take(terminal, 1, "Even light for the noise")
    take(terminal, 2, "Darkness for the noise")
    take(terminal, 3, "Board on the jig")
    terminal.until("Step 4 of 10")
    terminal.until("8 of 32 frames")
    assert terminal.stop() == 130
    assert "Stopped. Run the same command again" in terminal.shown.replace("\n", " ")
    assert "Traceback" not in terminal.shown


def go_on(terminal: Terminal) -> None:
    """Hold the board and the LED wrongly before they are captured, and capture the rest."""
    terminal.until("Step 4 of 10")
    terminal.type("wrong")
    terminal.until("0 of the board's corners are seen")
    terminal.type("again")
    terminal.until("✓ Board held by hand")
    take(terminal, 5, "Even light for the wire")
    take(terminal, 6, "Darkness for the wire")
    terminal.until("Step 7 of 10")
    terminal.until("[again")
    terminal.type("wrong")  # the second mistake since the start: a lit room
    terminal.until("Darken the room.")
    terminal.type("wrong")
    terminal.until("Move the LED so that its image goes")
    terminal.type("again")
    for cell in (1, 2, 3):
        terminal.until(f"✓ LED in cell {cell} of 3")
    take(terminal, 10, "Blackout for the panel's own light")
    terminal.until("Everything is captured.")
    terminal.stop()  # the fits are no part of this test


@pytest.mark.slow
def test_a_practice_of_all_terms_by_keys_gives_the_session_that_no_mistake_has_touched(tmp_path: Path) -> None:
    rig = write_five_term_rig(tmp_path)
    (tmp_path / "plain").mkdir()
    undisturbed(rig, tmp_path / "plain")
    for act in (do_wrong_at_first, go_on):
        with five_terms(rig, tmp_path) as terminal:
            act(terminal)
    one, other = (Session.open(folder / "s") for folder in (tmp_path / "plain", tmp_path))
    assert {step.term for step in one.manifest.steps} == set(TERMS)
    assert [step.id for step in one.manifest.steps] == [step.id for step in other.manifest.steps]
    for mine, theirs in zip(one.manifest.steps, other.manifest.steps, strict=True):
        if mine.id == "psf/p00_s0":
            # An LED that came from a wrong place rests where it is wanted, but not to the same thousandth of a pixel.
            assert isinstance(mine.subject, LedSubject)
            assert isinstance(theirs.subject, LedSubject)
            off = np.hypot(mine.subject.x_px - theirs.subject.x_px, mine.subject.y_px - theirs.subject.y_px)
            assert off < 0.2, mine.id
            continue
        assert mine.subject == theirs.subject, mine.id
        same = [capture.sha256 for capture in mine.captures] == [capture.sha256 for capture in theirs.captures]
        assert same, mine.id


@pytest.mark.medium
def test_quit_leaves_with_130_and_fits_nothing(rig: Path, tmp_path: Path) -> None:
    with Terminal(command(rig, tmp_path)) as terminal:
        terminal.until(_WAITS)
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
    with Terminal(command(rig, folder)) as first:
        first.until(_WAITS)
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
