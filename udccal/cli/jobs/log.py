"""Prints the past of a profile: when, with what and of which session it was made, and what it was derived from."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import final

from udccal.cli.output import Output
from udccal.profiles.history import PastProfile, PastTerm, history
from udccal.profiles.store import find_profile
from udccal.reports.tables import Table

# Digits of a SHA-256 that a person is shown.
_DIGITS = 12


@final
@dataclass(frozen=True)
class ProfileLog:
    """Result of ``profile log``: the profile and its ancestors, newest first."""

    profile: Path
    history: tuple[PastProfile, ...]


def log_profile(output: Output, path: Path) -> None:
    """Print a profile's provenance, its terms' statuses and notes, then those of each ancestor beside it.

    Args:
        output: shows the sentences and tables.
        path: folder or zip file of the profile, or a rig's name.

    Raises:
        ProfileError: when the profile cannot be read.
    """
    past = history(find_profile(path))
    for profile in past:
        for sentence in _sentences(profile):
            output.answer(sentence)
        output.table(_terms(profile))
        for term in profile.terms:
            for note in term.notes:
                output.answer(f"{term.term}: {note}")
    if past[-1].parent is not None:
        missing = past[-1].parent[:_DIGITS]
        output.answer(f"The profile {missing} is not beside {path}: what came before is not known here.")
    output.result(ProfileLog(path, past))


def _sentences(profile: PastProfile) -> Iterator[str]:
    made = profile.provenance
    yield f"{profile.path}: profile {profile.identity.sha256[:_DIGITS]}, format version {profile.identity.version}"
    yield f"  made {made.created_at} by udccal {made.udccal} (Python {made.python}, numpy {made.numpy}, jax {made.jax})"
    if made.camera is not None:
        camera = made.camera
        yield f"  camera {camera.vendor} {camera.model}, serial {camera.serial} ({camera.backend})"
    yield f"  session {'none' if made.session_sha256 is None else made.session_sha256[:_DIGITS]}"
    if made.command:
        yield f"  command {made.command}"
    if profile.parent is None:
        yield "  derived from no other profile"
        return
    terms = "terms that differ from it are not known"
    if profile.changed is not None:
        terms = f"terms that differ from it: {', '.join(profile.changed) or 'none'}"
    yield f"  derived from the profile {profile.parent[:_DIGITS]}; {terms}"


def _terms(profile: PastProfile) -> Table:
    rows = tuple((t.term, t.status, f"{t.chi2_dof:.3f}", _captured(t), t.effort or "not known") for t in profile.terms)
    return Table("Terms", ("term", "status", "reduced χ²", "captured", "effort"), rows, frozenset({2}))


def _captured(term: PastTerm) -> str:
    """When, and the digits that tell whether two fits used the same captures."""
    captures = term.captures
    return "not known" if captures is None else f"{captures.completed_at[1]} ({captures.sha256[:_DIGITS]})"
