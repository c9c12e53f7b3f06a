"""Pictures that a person shows on the panel of a real rig: with ``--yes`` too, somebody says that they are there."""

from __future__ import annotations

import io
import json
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.guide.painted import PaintedRig, painted_rig
from tests.guide.scripted import Scripted
from udccal.arrangements import Dark, PanelPicture
from udccal.cli.bench_options import BenchOptions, CameraKind, DisplayKind
from udccal.cli.jobs.capture import Wanted
from udccal.cli.jobs.guided import show_on_panel
from udccal.cli.jobs.terminal import TerminalPerson
from udccal.cli.output import Output
from udccal.errors import UdccalError
from udccal.guide.events import Answer, Event, Person, RequestEvent
from udccal.sessions.store import Session

LIT = PanelPicture(np.full((36, 64, 3), 255, np.uint8))


@pytest.fixture
def painted(monkeypatch: pytest.MonkeyPatch) -> PaintedRig:
    """The rig before a real camera: nothing but a person sets it up."""
    painted = PaintedRig(painted_rig())
    monkeypatch.setattr("udccal.cli.jobs.benches.u3v_camera", lambda serial: painted)
    return painted


def agreed(painted: PaintedRig, folder: Path, person: Person, output: Output | None = None) -> bool:
    """Capture the backscatter as ``--camera u3v --display manual --yes`` does."""
    options = BenchOptions(CameraKind.u3v, None, None, DisplayKind.manual, 0, 0)
    return options.capture(output or Output(), painted.rig, Wanted(folder, ["backscatter"]), person, agree=True)


def test_whoever_agrees_is_asked_for_each_picture(
    tmp_path: Path, painted: PaintedRig, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[str] = []

    def react(event: Event, offered: tuple[Answer, ...]) -> Answer | None:
        if not isinstance(event, RequestEvent):
            return None
        asked.append(event.sentence)
        painted.put = Dark() if event.sentence.startswith("Switch the panel off") else LIT
        return Answer.go

    person = Scripted(react)
    assert agreed(painted, tmp_path / "s", person, Output(events=True))
    assert [sentence.split()[0] for sentence in asked] == ["Show", "Switch", "Show", "Show"]
    assert person.prompts == len(asked)
    told = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [event["sentence"] for event in told if event["event"] == "request"] == asked


def test_whoever_quits_when_asked_for_a_picture_stops_the_capture(tmp_path: Path, painted: PaintedRig) -> None:
    """It was a step to try again, so that nobody could leave."""
    person = Scripted(lambda event, offered: Answer.quit if isinstance(event, RequestEvent) else None)
    assert not agreed(painted, tmp_path / "s", person)
    assert person.done.stopped
    assert sum(isinstance(event, RequestEvent) for event in person.events) == 1


def test_a_picture_to_show_is_no_verdict(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO("\n"))
    assert show_on_panel(TerminalPerson(Output()), "Show a.png on the panel.")
    said = capsys.readouterr().err
    assert "Show a.png on the panel. Go on when it is done." in said
    assert "[Enter · quit]" in said
    assert "✓" not in said


def test_without_anybody_to_ask_nothing_is_captured(
    tmp_path: Path, painted: PaintedRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    painted.put = LIT
    monkeypatch.setattr(sys, "stdin", io.StringIO(""))
    with pytest.raises(UdccalError, match="Expected a person to answer, found that standard input is closed"):
        agreed(painted, tmp_path / "s", TerminalPerson(Output()))
    assert painted.frames_taken == 0
    assert Session.open(tmp_path / "s").manifest.steps == ()
