"""Writes figures and tables to one self-contained HTML file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined

from udccal.io.atomic import write_atomically
from udccal.reports.tables import Table
from udccal.result import FitStatus
from udccal.sessions.schema import TermName


@dataclass(frozen=True)
class Fact:
    """One line of the report's head."""

    label: str
    value: str


@dataclass(frozen=True)
class Illustration:
    """A figure as a data URI, with a sentence that explains it."""

    uri: str
    caption: str
    alt: str


@dataclass(frozen=True)
class TermSection:
    """One term's chapter."""

    term: TermName
    heading: str
    explanation: str
    status: FitStatus
    finding: str
    illustrations: tuple[Illustration, ...]
    tables: tuple[Table, ...]
    details: tuple[Table, ...]
    notes: tuple[str, ...]

    @property
    def mood(self) -> str:
        """CSS class of the status: good, absent or bad."""
        moods = {FitStatus.CONVERGED: "good", FitStatus.ABSENT: "absent", FitStatus.NOT_CAPTURED: "absent"}
        return moods.get(self.status, "bad")


@dataclass(frozen=True)
class Page:
    """A whole report."""

    title: str
    verdict: str
    facts: tuple[Fact, ...]
    pictures: tuple[Illustration, ...]
    picture_sentence: str
    tables: tuple[Table, ...]
    sections: tuple[TermSection, ...]


def render(page: Page) -> str:
    """Return the page as HTML; all text is escaped."""
    environment = Environment(
        loader=PackageLoader("udccal.reports"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("report.html.j2").render(page=page)


def write_page(path: Path, page: Page) -> None:
    """Render ``page`` and write it to ``path`` atomically."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, render(page).encode("utf-8"))
