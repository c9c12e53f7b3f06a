"""What is known of a profile's past: its provenance, and the profiles that it was derived from."""

from __future__ import annotations

import contextlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import final, get_args

from udccal.errors import ProfileError
from udccal.io.links import is_plain_file
from udccal.io.whole_folder import read_standing
from udccal.profiles.archive import unpacked
from udccal.profiles.provenance import MAX_JSON_BYTES, PROFILE_NAME, profile_sha256
from udccal.profiles.schema import Provenance, Section, StoredCaptures, StoredProfile
from udccal.profiles.store import read_stored
from udccal.sessions.schema import TermName

# Names beside a profile among which its ancestors are looked for.
_MOST_BESIDE = 1000


@final
@dataclass(frozen=True)
class Identity:
    """What names the content of a profile: the SHA-256 of its ``profile.json``; and its format version as stored."""

    sha256: str
    version: int


@final
@dataclass(frozen=True)
class PastTerm:
    """How a term of one profile came about.

    Attributes:
        status: name of its ``FitStatus``. chi2_dof: of its fit. notes: sentences of its fit.
        effort, captures: of its fit; None where that is not known.
        changed: whether it differs from the same term of the parent; None where the parent is not at hand.
    """

    term: TermName
    status: str
    chi2_dof: float
    notes: tuple[str, ...]
    effort: str | None
    captures: StoredCaptures | None
    changed: bool | None


@final
@dataclass(frozen=True)
class PastProfile:
    """One profile of a lineage.

    Attributes:
        path: where it is. identity: its name by content. parent: SHA-256 of the profile it was derived from, or None.
        provenance: when, with what, from which session and by which command its numbers were made.
    """

    path: Path
    identity: Identity
    parent: str | None
    provenance: Provenance
    terms: tuple[PastTerm, ...]

    @property
    def changed(self) -> tuple[TermName, ...] | None:
        """The terms that differ from the parent's; None where there is no parent, or it is not at hand."""
        known = [term for term in self.terms if term.changed is not None]
        return tuple(term.term for term in known if term.changed) if known else None


@final
@dataclass(frozen=True)
class _Read:
    path: Path
    identity: Identity
    stored: StoredProfile


def identity(path: Path) -> Identity:
    """Return what names the content of a profile.

    Raises:
        ProfileError: when its ``profile.json`` is missing, damaged or newer.
    """
    return _read(path).identity


def history(path: Path) -> tuple[PastProfile, ...]:
    """Return a profile and those that it was derived from, newest first, as far as they are beside it.

    Args:
        path: folder or zip file of the profile. Its ancestors are looked for in the folder that holds it.

    Raises:
        ProfileError: when its ``profile.json`` is missing, damaged or newer.
    """
    chain = [_read(path)]
    beside: dict[str, Path] | None = None
    while parent := chain[-1].stored.lineage.parent:
        beside = _beside(path) if beside is None else beside
        if parent not in beside:
            break
        # Each is taken once, so that no lineage, however it was made, goes on for ever.
        chain.append(_read(beside.pop(parent)))
    older: list[_Read | None] = [*chain[1:], None]
    return tuple(_past(read, before) for read, before in zip(chain, older, strict=True))


def _read(path: Path) -> _Read:
    def read(place: Path) -> _Read:
        with unpacked(place, PROFILE_NAME) as folder:
            stored = read_stored(folder)
            version = json.loads((folder / PROFILE_NAME).read_bytes())["version"]
            return _Read(path, Identity(profile_sha256(folder), version), stored)

    return read_standing(path, read)


def _past(read: _Read, before: _Read | None) -> PastProfile:
    def term(name: TermName) -> PastTerm:
        section: Section = getattr(read.stored.terms, name)
        changed = None if before is None else _numbers(section) != _numbers(getattr(before.stored.terms, name))
        fit = section.fit
        return PastTerm(name, fit.status, fit.chi2_dof, fit.notes, fit.effort, fit.captures, changed)

    terms = tuple(term(name) for name in get_args(TermName))
    return PastProfile(read.path, read.identity, read.stored.lineage.parent, read.stored.provenance, terms)


def _numbers(section: Section) -> tuple[object, ...]:
    """What a refit changes of a term; notes are added to kept ones, too, and a migration words estimates anew."""
    unworded = tuple(one.model_copy(update={"what": ""}) for one in section.fit.estimates)
    return section.parameters, section.arrays, unworded


def _beside(path: Path) -> dict[str, Path]:
    """The profiles in the folder that holds a profile, by what names them."""
    found: dict[str, Path] = {}
    for place in sorted(path.absolute().parent.iterdir())[:_MOST_BESIDE]:
        # What cannot be read is no profile, and not the ancestor.
        with contextlib.suppress(ProfileError, OSError), unpacked(place, PROFILE_NAME) as folder:
            file = folder / PROFILE_NAME
            if is_plain_file(folder, file) and file.stat().st_size <= MAX_JSON_BYTES:
                found[profile_sha256(folder)] = place
    return found
