"""Writes figures and tables to one self-contained HTML file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

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
class Advice:
    """What a page begins with: a headline and at most three sentences; ``mood`` is a CSS class, such as good or bad."""

    headline: str
    mood: str
    sentences: tuple[str, ...]


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
        if self.status is FitStatus.CONVERGED:
            return "good"
        return "absent" if self.status in (FitStatus.ABSENT, FitStatus.NOT_CAPTURED, FitStatus.IMPORTED) else "bad"


@dataclass(frozen=True)
class Page:
    """A whole report."""

    template: ClassVar[str] = "report.html.j2"

    title: str
    advice: Advice
    facts: tuple[Fact, ...]
    pictures: tuple[Illustration, ...]
    picture_sentence: str
    tables: tuple[Table, ...]
    sections: tuple[TermSection, ...]


@dataclass(frozen=True)
class DiffSection:
    """One term's chapter."""

    term: str
    verdict: str
    finding: str
    effects: Table
    illustrations: tuple[Illustration, ...]
    estimates: Table
    notes: tuple[str, ...]

    @property
    def mood(self) -> str:
        """CSS class of the verdict."""
        return self.verdict.split()[-1]


@dataclass(frozen=True)
class DiffPage:
    """A comparison of two profiles."""

    template: ClassVar[str] = "diff.html.j2"

    title: str
    advice: Advice
    facts: tuple[Fact, ...]
    movement_sentence: str
    movement: Table
    sections: tuple[DiffSection, ...]


@dataclass(frozen=True)
class ValidationSection:
    """One term's chapter; ``mood`` is the CSS class of its verdict."""

    term: str
    verdict: str
    mood: str
    sentences: tuple[str, ...]
    checks: Table
    illustrations: tuple[Illustration, ...]


@dataclass(frozen=True)
class ValidationPage:
    """A profile's predictions of a session."""

    template: ClassVar[str] = "validation.html.j2"

    title: str
    advice: Advice
    facts: tuple[Fact, ...]
    sections: tuple[ValidationSection, ...]


AnyPage = Page | DiffPage | ValidationPage


def render(page: AnyPage) -> str:
    """Return the page as HTML; all text is escaped."""
    environment = Environment(
        loader=PackageLoader("udccal.reports"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(page.template).render(page=page)


def write_page(path: Path, page: AnyPage) -> None:
    """Render ``page`` and write it to ``path`` atomically."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, render(page).encode("utf-8"))
