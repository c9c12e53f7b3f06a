from __future__ import annotations

import pytest

from udccal.profiles.provenance import portable_command, provenance_now
from udccal.profiles.units import unit_of


def test_a_command_says_nothing_about_the_machine() -> None:
    command = portable_command(["/home/me/bin/udccal", "fit", "/data/mine/session", "--profile=/home/me/p", "--json"])
    assert command == "udccal fit session --profile=p --json"
    assert portable_command(["/home/me/lib/udccal/__main__.py", "fit", "session"]) == "python -m udccal fit session"
    assert portable_command([]) == ""


def test_a_command_with_a_name_that_is_no_text_can_be_stored(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["udccal", "fit", "sitzung\udcff"])
    assert '"udccal fit sitzung?"' in provenance_now(None, None).model_dump_json()


def test_units_follow_names() -> None:
    assert unit_of("diffraction.pitch_mm") == "mm"
    assert unit_of("fields_px.0") == "px"
    assert unit_of("geometry.focal_px") == "px"
    assert unit_of("dark_current_e_per_s") == "e-/s"
    assert unit_of("degree") == "1"
