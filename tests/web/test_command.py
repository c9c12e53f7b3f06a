"""The installed command with ``--web``: a person practises on a simulated rig before a page."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.chromium import Page, chromium
from tests.toy_rigs import write_toy_rig
from tests.web.looks import check_layout, says, see_the_picture
from udccal.sessions.store import Session

COMMAND = [sys.executable, "-m", "udccal.cli.main", "calibrate"]


@dataclass(frozen=True)
class Running:
    """The command, and the address that it has printed."""

    process: subprocess.Popen[str]
    address: str


@contextmanager
def practising(rig: Path, folder: Path, *words: str) -> Iterator[Running]:
    """Run a practice with a page; it does not outlive the test."""
    paths = {"--rig": rig, "--session": folder / "session", "--profile": folder / "profile"}
    given = [str(word) for pair in paths.items() for word in pair]
    command = [*COMMAND, *given, "--practice", "--web", *words]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            said = ""
            assert process.stderr is not None
            while (found := re.search(r"http://127\.0\.0\.1:\d+/\S+/", said)) is None:
                line = process.stderr.readline()
                assert line, said
                said += line
            yield Running(process, found[0])
        finally:
            process.terminate()


def noise_practice(folder: Path) -> AbstractContextManager[Running]:
    """A practice of the noise's steps alone."""
    return practising(write_toy_rig(folder), folder, "--term", "noise")


def take(page: Page) -> None:
    """Capture a step that is set up rightly."""
    says(page, "All is right.")
    page.tap("button.go")
    says(page, "frames captured.")


@pytest.mark.medium
def test_a_practice_with_a_mistake_and_a_reload_captures_every_step(tmp_path: Path) -> None:
    with chromium(tmp_path) as browser, noise_practice(tmp_path) as running:
        page = browser.open(running.address, 390, 844)
        says(page, "Step 1 of 2")
        see_the_picture(page)
        check_layout(page)
        page.tap("button.wrong")
        page.wait("document.querySelector('#said').className !== 'good' && document.querySelector('#readings .bad')")
        page.reload()
        page.tap("button.go")
        page.wait("document.querySelector('#said').className === 'bad'")
        check_layout(page)
        page.tap("button.go")
        take(page)
        page.tap("button.go")
        says(page, "Step 2 of 2")
        take(page)
        page.tap("button.go")
        says(page, "Everything is captured.")
        assert page.errors == []
        assert [address for address in page.requests if not address.startswith((running.address, "data:"))] == []
    steps = Session.open(tmp_path / "session").steps("noise")
    assert {step.id for step in steps} >= {"noise/flat_stack", "noise/flat_4", "noise/dark_stack", "noise/dark_7"}


@pytest.mark.medium
def test_stopping_on_the_page_ends_the_command(tmp_path: Path) -> None:
    with chromium(tmp_path) as browser, noise_practice(tmp_path) as running:
        page = browser.open(running.address, 1280, 800)
        page.tap("button.quit")
        page.tap("button.quit")
        says(page, "Stopped")
        assert running.process.wait(60.0) == 130
        assert not (tmp_path / "profile").exists()


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--web"], "--web are for --camera u3v or pylon, and for"),
        (["--practice", "--port", "8000"], "--port is for the page"),
        (["--practice", "--web", "--port", "70000"], "65535"),
    ],
)
def test_words_that_do_not_fit_are_refused(tmp_path: Path, words: list[str], sentence: str) -> None:
    paths = ["--rig", "lg55-reduced", "--session", str(tmp_path / "s"), "--profile", str(tmp_path / "p")]
    done = subprocess.run([*COMMAND, *paths, *words], capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert sentence in " ".join(re.sub(r"[│╭╮╰╯─]", " ", done.stderr).split())
    assert not (tmp_path / "s").exists()
