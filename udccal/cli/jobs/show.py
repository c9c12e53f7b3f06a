"""Prints what a profile holds as tables or as JSON."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import get_args

from udccal.cli.output import Output
from udccal.profiles.store import load_profile
from udccal.reports.fit_tables import estimates_table
from udccal.sessions.schema import TermName


@dataclass(frozen=True)
class ShownEstimate:
    """One quantity of a profile."""

    term: str
    name: str
    value: float
    sigma: float
    unit: str


@dataclass(frozen=True)
class ShownTerm:
    """How a term's fit ended."""

    term: str
    status: str
    chi2_dof: float
    notes: tuple[str, ...]


@dataclass(frozen=True)
class ProfileSummary:
    """Result of ``profile show``."""

    profile: Path
    rig: str
    created_at: str
    terms: tuple[ShownTerm, ...]
    estimates: tuple[ShownEstimate, ...]
    warnings: tuple[str, ...]
    invalidated_by: tuple[str, ...]


def show_profile(output: Output, path: Path) -> None:
    """Print every term's status, every quantity with its unit and sigma, and what is said of them.

    Args:
        output: shows the tables.
        path: folder or zip file of the profile, or a rig's name.

    Raises:
        ProfileError: when the profile cannot be read.
    """
    profile = load_profile(path)
    results = [(term, profile.result(term)) for term in get_args(TermName)]
    output.say(f"Profile of {profile.rig.name}, made {profile.provenance.created_at}")
    for term, result in results:
        output.table(estimates_table(f"{term}: {result.status.name.lower().replace('_', ' ')}", result))
        if result.unfitted:
            output.say(f"{term}: {result.status.value}")
        for sentence in (*result.notes, *filter(None, [result.warning])):
            output.say(sentence)
    output.result(
        ProfileSummary(
            profile=path,
            rig=profile.rig.name,
            created_at=profile.provenance.created_at,
            terms=tuple(ShownTerm(term, r.status.name, r.chi2_dof, r.notes) for term, r in results),
            estimates=tuple(
                ShownEstimate(term, e.name, e.value, e.sigma, e.unit) for term, r in results for e in r.estimates
            ),
            warnings=profile.warnings,
            invalidated_by=profile.invalidated_by,
        )
    )
