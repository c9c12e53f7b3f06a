"""The page: one self-contained file, everything escaped."""

from __future__ import annotations

import base64
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.reports.widths import layouts
from udccal.reports.page import Advice, Fact, Illustration, Page, TermSection, render, write_page
from udccal.reports.tables import Table
from udccal.result import FitStatus

DOT = "data:image/png;base64,iVBORw0KGgo="


def section(status: FitStatus = FitStatus.CONVERGED, finding: str = "K = 0.355 ± 0.001 DN/e-.") -> TermSection:
    table = Table("Fitted", ("quantity", "value"), (("K", "0.355"),), frozenset({1}))
    return TermSection(
        term="noise",
        heading="Noise",
        explanation="How the sensor counts.",
        status=status,
        finding=finding,
        illustrations=(Illustration(DOT, "What to see.", "photon transfer"),),
        tables=(table,),
        details=(table,),
        notes=("A note.",),
    )


def page(*sections: TermSection) -> Page:
    return Page(
        title="Calibration of toy",
        advice=Advice("All five terms can be used.", "good", ("Restore with this profile.",)),
        facts=(Fact("rig", "toy"),),
        pictures=(Illustration(DOT, "Before.", "before"),),
        picture_sentence="From 21 dB to 32 dB.",
        tables=(Table("Fitted against the simulated truth", ("term",), (("noise",),)),),
        sections=sections,
    )


class _Tags(HTMLParser):
    """Checks that tags nest, and collects what they refer to."""

    VOID = frozenset({"meta", "img", "br"})

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.references: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.references += [value or "" for name, value in attrs if name in ("src", "href")]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def test_the_page_is_whole_and_refers_to_nothing_outside(tmp_path: Path) -> None:
    file = tmp_path / "deep" / "report.html"
    write_page(file, page(section()))
    text = file.read_text(encoding="utf-8")
    tags = _Tags()
    tags.feed(text)
    assert not tags.open
    assert all(reference.startswith(("data:image/png;base64,", "#")) for reference in tags.references)
    assert not re.search(r"https?://", text)
    for said in ("Calibration of toy", "K = 0.355 ± 0.001", "The fit converged.", "A note.", "From 21 dB to 32 dB."):
        assert said in text


def test_the_page_begins_with_what_to_do() -> None:
    text = render(page(section()))
    before = text.partition("Restore with this profile.")[0]
    assert '<h2 class="verdict">All five terms can be used.</h2>' in before
    for later in ("<table", "<figure", "K = 0.355 ± 0.001", 'class="facts"'):
        assert later in text
        assert later not in before


def test_a_bad_status_shows_its_advice() -> None:
    text = render(page(section(FitStatus.SATURATED)))
    assert FitStatus.SATURATED.value in text
    assert 'class="bad"' in text


def test_text_is_escaped() -> None:
    text = render(page(section(finding="<script>alert(1)</script>")))
    assert "<script>" not in text
    assert "&lt;script&gt;" in text


def wide_page() -> str:
    """A page with tables of many columns, a large picture and a word without a break."""
    picture = base64.b64encode(_png(900, 300)).decode()
    row = tuple(f"{1 / (3 + k):.9f}" for k in range(9))
    wide = Table(
        "Fitted, in many columns", tuple(f"quantity_{k}" for k in range(9)), (row, row), frozenset(range(1, 9))
    )
    one = replace(
        section(finding="a" * 200),
        illustrations=(Illustration(f"data:image/png;base64,{picture}", "What to see. " * 20, "wide"),),
        tables=(wide,),
        details=(wide, wide),
        notes=("b" * 200,),
    )
    return render(replace(page(one), tables=(wide,), facts=(Fact("camera", "c" * 200),)))


def _png(columns: int, rows: int) -> bytes:
    return bytes(cv2.imencode(".png", np.zeros((rows, columns, 3), np.uint8))[1])


@pytest.mark.medium
def test_only_tables_scroll_sideways_however_narrow_the_window(tmp_path: Path) -> None:
    for layout in layouts(wide_page(), tmp_path):
        assert not layout.sideways, layout
        assert layout.outside == (), layout
        assert layout.scrolling == (4 if layout.width < 500 else layout.scrolling), layout


@pytest.mark.medium
def test_a_table_that_leaves_its_card_would_be_noticed(tmp_path: Path) -> None:
    text = wide_page()
    for rule, broken in (("overflow-x: auto;", ""), ("min-width: 0;", "min-width: max-content;")):
        assert rule in text
        (layout,) = layouts(text.replace(rule, broken), tmp_path, (390,))
        assert layout.sideways or layout.outside


def test_the_rules_that_keep_tables_in_their_cards_are_there() -> None:
    text = wide_page()
    assert text.count("<table>") == text.count('<div class="table"') == 4
    for rule in (".table { overflow-x: auto; ", ".columns > div { min-width: 0; }", "minmax(min(360px, 100%), 1fr)"):
        assert rule in text
