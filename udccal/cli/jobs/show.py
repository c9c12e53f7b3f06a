"""Prints what a profile holds as tables or as JSON."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import get_args

from udccal.cli.output import Output
from udccal.comparison.rig_state import rig_state
from udccal.profiles.store import load_profile
from udccal.quantities import quantity
from udccal.reports.fit_tables import captures_sentence, estimates_table, imported_numbers, imported_table, state_table
from udccal.result import Captures, Effort, Estimate, EstimatePrior, Outliers
from udccal.sessions.schema import TermName


@dataclass(frozen=True)
class ShownEstimate:
    """One quantity of a profile, or of the rig as all terms find it; ``by_prior`` says that the prior decides."""

    term: str
    name: str
    value: float
    sigma: float
    unit: str
    what: str
    prior: EstimatePrior | None
    by_prior: bool


@dataclass(frozen=True)
class ShownNumber:
    """One quantity of a term that was imported: nobody knows its sigma."""

    term: str
    name: str
    value: float
    unit: str
    what: str


@dataclass(frozen=True)
class ShownTerm:
    """How a term's fit ended."""

    term: str
    status: str
    chi2_dof: float
    notes: tuple[str, ...]
    captures: Captures | None
    effort: Effort | None
    outliers: tuple[Outliers, ...]


@dataclass(frozen=True)
class ShownState:
    """The rig as all terms find it; the covariance is in the order of the estimates."""

    estimates: tuple[ShownEstimate, ...]
    covariance: tuple[tuple[float, ...], ...]
    agreement_chi2: float
    agreement_dof: int
    agreement_p_value: float
    terms: tuple[str, ...]


@dataclass(frozen=True)
class ProfileSummary:
    """Result of ``profile show``."""

    profile: Path
    rig: str
    created_at: str
    terms: tuple[ShownTerm, ...]
    estimates: tuple[ShownEstimate, ...]
    imported: tuple[ShownNumber, ...]
    rig_state: ShownState
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
        table = imported_table if imported_numbers(result) else estimates_table
        output.table(table(f"{term}: {result.status.name.lower().replace('_', ' ')}", result))
        if result.unfitted:
            output.say(f"{term}: {result.status.value}")
        for sentence in filter(None, (*result.notes, captures_sentence(result), result.warning)):
            output.say(sentence)
    state = rig_state(profile)
    if state.terms:
        output.table(state_table(state))
    output.result(
        ProfileSummary(
            profile=path,
            rig=profile.rig.name,
            created_at=profile.provenance.created_at,
            terms=tuple(
                ShownTerm(term, r.status.name, r.chi2_dof, r.notes, r.captures, r.effort, r.outliers)
                for term, r in results
            ),
            estimates=tuple(_shown(term, e) for term, r in results for e in r.numbers),
            imported=tuple(_imported(term, *item) for term, r in results for item in imported_numbers(r).items()),
            rig_state=ShownState(
                estimates=tuple(_shown("rig", e) for e in state.estimates),
                covariance=tuple(tuple(row) for row in state.cov.tolist()),
                agreement_chi2=state.agreement_chi2,
                agreement_dof=state.agreement_dof,
                agreement_p_value=state.agreement_p_value,
                terms=state.terms,
            ),
            warnings=profile.warnings,
            invalidated_by=profile.invalidated_by,
        )
    )


def _shown(term: str, one: Estimate) -> ShownEstimate:
    what = quantity(term, one.name).what
    return ShownEstimate(term, one.name, one.value, one.sigma, one.unit, what, one.prior, one.by_prior)


def _imported(term: str, name: str, value: float) -> ShownNumber:
    known = quantity(term, name)
    return ShownNumber(term, name, value, known.unit, known.what)
