from __future__ import annotations

from xml.etree import ElementTree

import pytest

from udccal.arrangements import Arrangement, Dark, FlatLight, Led
from udccal.drift.check import short_rig
from udccal.guide.capture import expected_seconds, guided_steps
from udccal.guide.drawing import side_view
from udccal.rig import load_rig

RIG = load_rig("lg55-aca2040")
SVG = "{http://www.w3.org/2000/svg}"


def drawn(arrangement: Arrangement) -> ElementTree.Element:
    return ElementTree.fromstring(side_view(RIG, arrangement))


def test_the_rig_is_drawn_to_scale() -> None:
    drawing = drawn(Led(1023.5, 767.5, 2000.0, 1.15))
    panel = drawing.find(f"{SVG}line")
    assert float(panel.get("y2")) == pytest.approx(1080 * 0.63, abs=0.1)
    led = drawing.find(f"{SVG}circle")
    assert float(led.get("cx")) == pytest.approx(2000.0, abs=0.1)
    # The middle of the sensor looks 17 degrees down from the pupil, 14 mm behind row 300 of the panel.
    assert float(led.get("cy")) == pytest.approx(300 * 0.63 + 2014 * 0.3057, abs=3)
    left, top, width, height = (float(value) for value in drawing.get("viewBox").split())
    assert left < -60
    assert left + width > 2000
    assert top < 0
    assert top + height > 1000


def test_what_a_person_sets_up_is_marked() -> None:
    assert [each.get("class") for each in drawn(FlatLight()) if "wanted" in each.get("class", "")]
    assert "cap on the lens" in drawn(Dark()).find(f"{SVG}text").text


def test_every_step_has_its_time() -> None:
    rig = RIG.model_copy(update={"captures": RIG.captures.model_copy(update={"psf_columns": 2, "psf_rows": 1})})
    steps = guided_steps(rig, ["wire", "psf"])
    seconds = expected_seconds(rig, steps)
    assert len(seconds) == len(steps) == 4
    assert seconds[0] == pytest.approx(45 + 300 / 120, abs=0.1)
    assert all(each > 8 * 6 for each in seconds[2:])


def test_a_check_takes_three_minutes() -> None:
    seconds = expected_seconds(rig := short_rig(RIG), guided_steps(rig, ["wire", "backscatter"]))
    assert len(seconds) == 3
    assert 45 * 3 < sum(seconds) < 180
    assert sum(expected_seconds(RIG, guided_steps(RIG, ["wire", "geometry"]))) > 180
