"""The page: one self-contained file, everything escaped."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from pathlib import Path

from udccal.reports.page import Fact, Illustration, Page, TermSection, render, write_page
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
        verdict="All five terms can be used.",
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


def test_a_bad_status_shows_its_advice() -> None:
    text = render(page(section(FitStatus.SATURATED)))
    assert FitStatus.SATURATED.value in text
    assert 'class="bad"' in text


def test_text_is_escaped() -> None:
    text = render(page(section(finding="<script>alert(1)</script>")))
    assert "<script>" not in text
    assert "&lt;script&gt;" in text
