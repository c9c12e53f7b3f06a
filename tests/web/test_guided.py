"""A whole guided capture before the page: every step of a painted rig, with three mistakes and a reload."""

from __future__ import annotations

import json
import threading
from pathlib import Path
from typing import Final

import pytest

from tests.chromium import Page, chromium
from tests.guide.painted import PaintedRig, painted_bench, painted_rig
from tests.web.looks import SIZES, check_layout, says
from udccal.arrangements import Arrangement, FlatLight
from udccal.benches.capture import TERMS
from udccal.guide.capture import guided_steps, lead_capture
from udccal.guide.events import DoneEvent
from udccal.guide.steps import GuidedStep
from udccal.sessions.store import Session
from udccal.sessions.writer import SessionWriter
from udccal.web.page import serve
from udccal.web.person import WebPerson
from udccal.web.picture import Sampling

# What a person does wrong at first, and what the page then says.
MISTAKES: Final[dict[str, tuple[Arrangement, str]]] = {
    "noise/dark_stack": (FlatLight(), "light leak"),
    "geometry/panel": (FlatLight(), "corners"),
    "psf/p00": (FlatLight(), "Darken the room."),
}


def walk(page: Page, painted: PaintedRig, steps: tuple[GuidedStep, ...]) -> None:
    """Set up and capture every step; correct each mistake when the page has told of it, once after a reload."""
    following = [*steps[1:], None]
    for step, after in zip(steps, following, strict=True):
        if step.by_itself and step.id not in MISTAKES:
            continue  # it is over as soon as the light rests
        page.wait(f"known.step === {json.dumps(step.id)}")
        if step.id in MISTAKES:
            page.wait("document.querySelector('#said.warn, #said.bad, #readings .bad')")
            says(page, MISTAKES[step.id][1])
            check_layout(page)
            if step.id == "geometry/panel":
                page.reload()
                says(page, step.title)
            painted.put = None
        if step.by_itself:
            continue
        says(page, "All is right.")
        check_layout(page)
        page.tap("button.go")
        says(page, "frames captured.")
        if after is not None and after.id in MISTAKES:
            painted.put = MISTAKES[after.id][0]
        page.tap("button.go")


@pytest.mark.medium
@pytest.mark.parametrize(("width", "height"), SIZES)
def test_a_whole_rig_is_captured_with_mistakes_and_a_reload(tmp_path: Path, width: int, height: int) -> None:
    painted = PaintedRig(painted_rig(fewer=4, psf_columns=2, psf_rows=1))
    bench, person, done = painted_bench(painted), WebPerson(Sampling.of(painted.rig)), list[DoneEvent]()

    def capture() -> None:
        with SessionWriter.create_or_resume(tmp_path / "s", bench.rig, bench.camera.identity, now=bench.now) as writer:
            done.append(lead_capture(writer, bench, person))

    thread = threading.Thread(target=capture, daemon=True)
    with chromium(tmp_path) as browser, serve(person, 0) as address:
        thread.start()
        page = browser.open(address, width, height)
        walk(page, painted, guided_steps(painted.rig))
        says(page, "Everything is captured.")
        check_layout(page)
        thread.join(60.0)
        assert page.errors == []
        assert [one for one in page.requests if not one.startswith((address, "data:"))] == []
    assert done[0].complete
    assert all(Session.open(tmp_path / "s").steps(term) for term in TERMS)
