"""The pages of a validation and of a check: what they say first, and that they refer to nothing outside."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from tests.reports.widths import layouts
from tests.scenes.wire import drawn_truth, geometry, start
from udccal.drift.causes import Explained
from udccal.drift.changes import Change
from udccal.drift.check import RigCheck, Solved, Verdict
from udccal.drift.limits import DriftLimits
from udccal.drift.pose import PoseChange
from udccal.reports.check_page import check_page
from udccal.reports.page import AnyPage, render
from udccal.reports.validation_page import validation_page
from udccal.sessions.schema import TermName
from udccal.validation.checks import Check, ZMap
from udccal.validation.limits import ValidationLimits
from udccal.validation.validate import Validation

pytestmark = pytest.mark.medium


def validated(ok: bool, own: tuple[TermName, ...] = (), partly: tuple[TermName, ...] = ("psf",)) -> AnyPage:
    checks = (
        Check("wire", "pattern", 0.1 if ok else 0.5, 0.2, "%", ok, "The flat has a pattern."),
        Check("psf", "NOT_CAPTURED", None, None, "", None, "The session has no captures of this term."),
    )
    stated = ("2026-01-01T00:00:00+00:00", "2026-01-02T00:00:00+00:00", "0" * 64)
    found = Validation("f", 1, "toy", ok, "Do <this>.", *stated, own, partly, checks, ValidationLimits())
    return validation_page(found, {"wire": ZMap(np.eye(5), "x", "y", "A map.")})


def checked(verdict: Verdict) -> AnyPage:
    change = Change("moved", 0.05, 0.001, 0.03, "mm", verdict != "same", "The camera moved.", "Calibrate.")
    none = np.zeros(7)
    pose = PoseChange(none, np.eye(7), drawn_truth(5, start(), geometry()), np.zeros((24, 32)), np.ones((24, 32)), 1.0)
    found = RigCheck("f", 1, "toy", verdict, ("moved",), "Do <this>.", (change,), (0.0, 0.0, 0.0), 1.0, DriftLimits())
    return check_page(found, Solved(pose, Explained((), none, np.eye(7)), np.ones(3), 1.0))


@pytest.mark.parametrize(
    ("page", "headline"),
    [
        (lambda: validated(True, partly=()), "The profile holds."),
        (lambda: validated(True), "The profile holds for wire."),
        (lambda: validated(True, own=("wire",)), "No test: the profile was fitted to these captures."),
        (lambda: validated(True, partly=("wire",)), "No test: the profile was fitted to these captures."),
        (lambda: validated(False), "The profile does not hold."),
        (lambda: checked("same"), "The rig is as its profile says."),
        (lambda: checked("changed"), "The rig changed by more than is harmless."),
    ],
)
def test_a_page_begins_with_what_to_do(page, headline: str, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    text = render(page())
    assert text.index(headline) < text.index("Do &lt;this&gt;.") < text.index("<nav")
    assert not re.findall(r"(?:src|href)=\"(?!data:|#)", text)
    for layout in layouts(text, tmp_path):
        assert not layout.sideways
