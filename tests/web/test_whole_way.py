"""A whole calibration of all five terms by the installed commands and a browser: page, report, diff and validation."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Final

import pytest

from tests.chromium import Browser, Page, chromium
from tests.toy_rigs import write_five_term_rig
from tests.web.looks import SIZES, check_layout, says
from tests.web.test_command import COMMAND, practising
from udccal.benches.capture import TERMS
from udccal.profiles.store import read_profile
from udccal.result import FitStatus

# What a person does wrong at first, and what the page then says.
MISTAKES: Final = {"noise/dark_stack": "light leak", "geometry/panel": "corners", "psf/p00": "LED"}
# Guided steps that wait for nobody once their light is right.
BY_ITSELF: Final = ("geometry/views", "psf/")
FIT_S: Final = 900.0
# The simulator computes its blur before the first board is seen, and a pattern of light for each place of the LED.
SIMULATED_S: Final = 300.0


def next_step(page: Page, before: str) -> str:
    """Wait for another step than the one before, and return its name; none when everything is captured."""
    done = "document.body.innerText.includes('Everything is captured.')"
    page.wait(f"{done} || (known.step && known.step !== {json.dumps(before)})", SIMULATED_S)
    return "" if page.run(done) else str(page.run("known.step"))


def err(page: Page, step: str) -> None:
    """Make the step's mistake, see that the page tells of it, load the page anew amid one, and set it right."""
    page.tap("button.wrong")
    page.wait("document.querySelector('#readings .bad')")
    says(page, MISTAKES[step])
    check_layout(page)
    if step == "geometry/panel":
        page.reload()
        says(page, MISTAKES[step])
    if step.startswith(BY_ITSELF):
        page.tap("button.again")
        return
    page.tap("button.go")
    page.wait("document.querySelector('#said').className === 'bad'")
    page.tap("button.go")


def walk(page: Page) -> list[str]:
    """Capture every step; returns their names."""
    walked: list[str] = []
    while step := next_step(page, walked[-1] if walked else ""):
        walked.append(step)
        page.wait("document.querySelector('#readings li')", SIMULATED_S)
        if step in MISTAKES:
            err(page, step)
        if step.startswith(BY_ITSELF):
            continue
        says(page, "All is right.")
        check_layout(page)
        page.tap("button.go")
        says(page, "frames captured.")
        page.tap("button.go")
    return walked


def run(*words: str | Path, status: tuple[int, ...] = (0,)) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "udccal.cli.main", *map(str, words)], capture_output=True, text=True, timeout=FIT_S
    )
    assert done.returncode in status, done.stderr


def check_page(browser: Browser, file: Path) -> None:
    """Read a page at every width: nothing sticks out, nothing is asked for elsewhere, and nothing goes wrong."""
    for width, height in SIZES:
        page = browser.open(file.as_uri(), width, height)
        page.run("document.querySelectorAll('details').forEach(each => each.open = true)")
        assert not page.scrolls_sideways
        assert all(term in page.text.lower() for term in TERMS)
        assert page.errors == []
        assert [asked for asked in page.requests if not asked.startswith(("file:", "data:"))] == []


@pytest.mark.slow
def test_a_practice_of_all_terms_on_a_page_is_fitted_compared_and_validated(tmp_path: Path) -> None:
    rig = write_five_term_rig(tmp_path)
    practice = practising(rig, tmp_path, *(word for term in TERMS for word in ("--term", term)))
    with chromium(tmp_path) as browser, practice as running:
        page = browser.open(running.address, 390, 844)
        walked = walk(page)
        assert set(MISTAKES) < set(walked)
        assert page.errors == []
        assert [asked for asked in page.requests if not asked.startswith((running.address, "data:"))] == []
        assert running.process.wait(FIT_S) in (0, 3)
        mine, other = tmp_path / "profile", tmp_path / "other"
        profile = read_profile(mine)
        assert all(getattr(profile, term).status is not FitStatus.NOT_CAPTURED for term in TERMS)
        check_page(browser, tmp_path / "profile-report.html")
        places = ("--rig", rig, "--session", tmp_path / "day", "--profile", other)
        run(*COMMAND[3:], *places, "--practice", "--yes", "--noise-seed", "1", status=(0, 3))
        run("profile", "diff", mine, other, "--out", tmp_path / "diff", status=(0, 3))
        check_page(browser, tmp_path / "diff" / "diff.html")
        validated = ("--session", tmp_path / "day", "--out", tmp_path / "validation")
        run("profile", "validate", mine, *validated, status=(0, 3))
        check_page(browser, tmp_path / "validation" / "validation.html")
