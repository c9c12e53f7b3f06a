"""Some terms of a session fitted again; the others come from the session's profile."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from udccal.calibration import ORDER, Calibration, Foundation
from udccal.effort import FitEffort
from udccal.errors import ProfileError
from udccal.io.hashing import sha256_file
from udccal.profiles.profile import Profile
from udccal.result import FitResult
from udccal.sessions.manifest import MANIFEST_NAME
from udccal.sessions.schema import TermName
from udccal.sessions.store import Session
from udccal.term_fits import TermFits

# The terms whose fit uses each term.
_USERS: dict[TermName, tuple[TermName, ...]] = {
    "noise": ("geometry", "wire", "psf", "backscatter"),
    "geometry": ("wire", "psf", "backscatter"),
    "wire": ("psf", "backscatter"),
    "psf": (),
    "backscatter": (),
}


def refit(
    session: Session,
    profile: Profile,
    terms: Sequence[TermName],
    progress: Callable[[TermName], None] = lambda term: None,
    effort: FitEffort | None = None,
) -> Calibration:
    """Fit some terms of a session again, with the other terms of its profile as they are.

    The wire fit goes on from the profile's wire. Wire, psf and backscatter contain the geometry: they are fitted again
    with it. A kept term that was fitted with an earlier form of another one gets a note that says so. Kept terms have
    no posterior: a profile holds the covariance of their estimates only.

    Args:
        session: the captured session.
        profile: of this session.
        terms: those to fit.
        progress: called with a term's name when its fit begins.
        effort: effort of the fits.

    Raises:
        ProfileError: when the profile is of another session, or of this one before it changed.
        SessionError: when a file of the session is missing or damaged.
    """
    _check_same(session, profile)
    again = {*terms, *(_USERS["geometry"] if "geometry" in terms else ())}
    fits = TermFits(session, effort, progress, profile.wire.term)
    for term in ORDER:
        if term not in again:
            setattr(fits, term, _kept(profile.result(term), [name for name in ORDER if name in again]))
    if "wire" not in again:
        fits.wire_map = profile.wire_map.astype(np.float64)
    base = fits.noise, fits.geometry, fits.wire
    foundation = Foundation(*base, tuple(fits.times), fits.wire_map, fits.boards)
    return Calibration(session, foundation, fits.psf, fits.backscatter, tuple(fits.times))


def _kept(result: FitResult, again: list[TermName]) -> FitResult:
    """A result of the profile, with a note where it was fitted with terms that are now fitted ``again``."""
    stale = [f"Fitted with an earlier {name} term." for name in again if result.name in _USERS[name]]
    return replace(result, notes=(*result.notes, *(note for note in stale if note not in result.notes)))


def _check_same(session: Session, profile: Profile) -> None:
    if profile.provenance.session_sha256 != sha256_file(session.path / MANIFEST_NAME):
        raise ProfileError(
            f"Expected a profile of the session {session.path}, found one of another session, or of this one before it "
            "changed. Fit all terms."
        )
