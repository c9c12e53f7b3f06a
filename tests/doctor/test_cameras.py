from __future__ import annotations

from dataclasses import replace
from importlib.metadata import PackageNotFoundError

import pytest

from udccal.doctor import cameras
from udccal.doctor.answers import Failure, OpenedCamera, SeenCamera
from udccal.doctor.cameras import camera_finding, pylon_sdk_finding, rig_finding
from udccal.doctor.finding import Finding, Status
from udccal.rig import load_rig

GOOD = SeenCamera("Basler ace 1", serial="1")
SLOW = SeenCamera("Basler ace 2", too_slow=True, serial="2")
HELD = SeenCamera("Basler ace 3", trouble="Expected it free, found it held. Close that program.", serial="3")
HIDDEN = SeenCamera("a camera without a name", trouble="Expected permission. Install the rule.")


@pytest.mark.parametrize("asked", [False, True])
def test_a_camera_that_can_be_opened_is_fine(asked: bool) -> None:
    finding = camera_finding("u3v", (GOOD, SLOW, HELD), asked, "1")
    assert finding.topic == "cameras by u3v"
    assert finding.status is Status.OK
    assert "Basler ace 1; Basler ace 2 (at a port or cable that is slower than the camera)" in finding.found
    assert "Close that program" in finding.advice


@pytest.mark.parametrize(
    ("seen", "serial", "advice"),
    [
        ((GOOD,), None, ""),
        ((GOOD, SLOW), None, "Expected one camera, found 2. Choose one with --serial."),
        ((GOOD, SLOW), "2", ""),
        ((GOOD, SLOW), "4", "Expected a camera of the serial number 4, found 1, 2."),
        ((GOOD, HELD), "3", "Close that program"),
        ((GOOD, HIDDEN), "4", "Install the rule."),
    ],
    ids=["only one", "several", "that one", "another", "held", "unreadable"],
)
def test_the_camera_of_that_serial_number_must_be_there(
    seen: tuple[SeenCamera, ...], serial: str | None, advice: str
) -> None:
    finding = camera_finding("u3v", seen, True, serial)
    assert finding.status is (Status.PROBLEM if advice else Status.OK)
    assert advice in finding.advice
    assert camera_finding("u3v", seen, False, serial).status is Status.OK


@pytest.mark.parametrize(
    ("answer", "found", "advice"),
    [
        ((), "none seen", "Plug the camera in"),
        ((HELD,), "cannot be opened", "Close that program"),
        (Failure("no answer within 30 s"), "no answer within 30 s", "Unplug the camera"),
        (Failure("Expected libusb, found none. Install it.", True), "cannot look", "Install it."),
    ],
    ids=["none", "held", "hung", "missing"],
)
def test_none_to_open_is_a_note_and_a_problem_only_when_asked_for(
    answer: tuple[SeenCamera, ...] | Failure, found: str, advice: str
) -> None:
    for asked, status in ((False, Status.NOTE), (True, Status.PROBLEM)):
        finding = camera_finding("u3v", answer, asked)
        assert finding.status is status
        assert found in finding.found
        assert advice in finding.advice or not (asked or answer)


def test_the_sdk_is_a_note_when_missing_and_a_problem_when_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(name: str) -> str:
        raise PackageNotFoundError(name)

    monkeypatch.setattr(cameras, "version", absent)
    assert pylon_sdk_finding(False).status is Status.NOTE
    assert pylon_sdk_finding(True).status is Status.PROBLEM
    assert "pip install 'udccal[pylon]'" in pylon_sdk_finding(False).advice
    monkeypatch.setattr(cameras, "version", lambda name: "1.2")
    assert pylon_sdk_finding(True) == Finding("pylon SDK", Status.OK, "pypylon 1.2")


FITS = OpenedCamera(1024, 768, 120.0, 2e-5, 10.0)


@pytest.mark.parametrize(
    ("answer", "status", "advice"),
    [
        (FITS, Status.OK, ""),
        (replace(FITS, columns=4096, rows=4096), Status.PROBLEM, "1024 x 768 as in the rig 'lg55-reduced', found 4096"),
        (replace(FITS, rows=766), Status.PROBLEM, "found 1024 x 766"),
        (replace(FITS, refusal="Expected RGGB, found mono."), Status.PROBLEM, "Expected RGGB, found mono."),
        (replace(FITS, longest_s=1.0), Status.PROBLEM, "Expected exposures of 2e-05 to 10 s"),
        (replace(FITS, shortest_s=1e-3), Status.PROBLEM, "found 0.001 to 10 s"),
        (replace(FITS, rate_hz=60.0), Status.NOTE, "The rig says 120 Hz"),
        (Failure("Expected it free, found it held.", refused=True), Status.PROBLEM, "found it held"),
        (Failure("no answer within 30 s"), Status.PROBLEM, "Unplug the camera"),
    ],
    ids=["fits", "size", "rows", "pattern", "longest", "shortest", "rate", "held", "hung"],
)
def test_the_camera_is_compared_with_the_rig(answer: OpenedCamera | Failure, status: Status, advice: str) -> None:
    finding = rig_finding(load_rig("lg55-reduced"), answer)
    assert finding.topic == "camera against rig"
    assert finding.status is status
    assert advice in finding.advice


def test_only_notes_become_problems() -> None:
    for status in (Status.OK, Status.PROBLEM):
        assert Finding("t", status, "f").needed(True).status is status
    assert Finding("t", Status.NOTE, "f").needed(False).status is Status.NOTE
