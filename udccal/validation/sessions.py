"""Validation of a session by another one of the same rig: what both captured, compared directly."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import final

from udccal.comparison.comparable import check_sessions
from udccal.comparison.estimates import ORDER
from udccal.errors import MissingStepError, SessionError
from udccal.io.hashing import sha256_file
from udccal.sessions.manifest import MANIFEST_NAME
from udccal.sessions.schema import TermName
from udccal.sessions.store import Session, check_session
from udccal.validation.checks import Check, Judged, ZMap
from udccal.validation.limits import ValidationLimits
from udccal.validation.pairs import compare_flats, compare_noise, compare_panel

FORMAT, VERSION = "udccal-session-comparison", 1


@final
@dataclass(frozen=True, eq=False)
class SessionComparison:
    """Whether two sessions show the same rig. docs/validate.md describes each number.

    Attributes:
        ok: whether every check that counts is within its limit.
        advice: one sentence that says what to do.
        checks: of all terms, in their order.
    """

    format: str
    version: int
    rig: str
    ok: bool
    advice: str
    session_created_at: str
    session_sha256: str
    against_created_at: str
    against_sha256: str
    checks: tuple[Check, ...]
    limits: ValidationLimits


def compare_sessions(session: Session, against: Session, limits: ValidationLimits | None = None) -> SessionComparison:
    """Compare what two sessions of one rig have captured alike, without any fit.

    Args:
        session: one session.
        against: another one of the same rig and camera.
        limits: of the checks; None for those of docs/validate.md.

    Returns:
        every check with its value, its limit and one sentence.

    Raises:
        SessionError: when they are of different rigs or cameras, are the same one, or share no captures, or when a
            file is missing or damaged.
        FitError: when frames are not what a fit takes.
    """
    for one in (session, against):
        check_session(one)
    return compared(session, against, limits or ValidationLimits())[0]


def compared(
    session: Session,
    against: Session,
    limits: ValidationLimits,
    progress: Callable[[TermName], None] = lambda term: None,
) -> tuple[SessionComparison, Mapping[TermName, ZMap]]:
    """Compare, and keep the maps for figures; see ``compare_sessions``. ``progress`` gets each term when it begins."""
    check_sessions(session, against)
    sha256, other = (sha256_file(one.path / MANIFEST_NAME) for one in (session, against))
    if sha256 == other:
        raise SessionError("Expected two sessions, found the same one twice. Give another session of this rig.")
    judged: dict[TermName, Judged] = {}
    for term in ORDER:
        progress(term)
        judged[term] = _judged(term, session, against, limits)
    checks = tuple(check for one in judged.values() for check in one.checks)
    if all(check.ok is None for check in checks):
        raise SessionError(
            "Expected captures of noise, wire or backscatter in both sessions, found none. Capture some of them first."
        )
    failed = tuple(dict.fromkeys(check.term for check in checks if check.ok is False))
    answer = SessionComparison(
        format=FORMAT,
        version=VERSION,
        rig=session.rig.name,
        ok=not failed,
        advice=_advice(failed),
        session_created_at=session.manifest.created_at,
        session_sha256=sha256,
        against_created_at=against.manifest.created_at,
        against_sha256=other,
        checks=checks,
        limits=limits,
    )
    return answer, {term: one.z_map for term, one in judged.items() if one.z_map is not None}


def _judged(term: TermName, session: Session, against: Session, limits: ValidationLimits) -> Judged:
    if not session.steps(term) or not against.steps(term):
        return _not_counted(term, "NOT_CAPTURED", "One of the sessions has no captures of this term.")
    try:
        return _by_captures(term, session, against, limits)
    except MissingStepError as error:
        return _not_counted(term, "NOT_CAPTURED", f"One of the sessions has captures of a part of this term. {error}")


def _by_captures(term: TermName, session: Session, against: Session, limits: ValidationLimits) -> Judged:
    match term:
        case "noise":
            return compare_noise(against, session, limits)
        case "wire":
            return compare_flats(against, session, limits)
        case "backscatter":
            return compare_panel(against, session, limits)
        case "geometry" | "psf":
            what = "Boards and LEDs stand elsewhere in each session: a profile can predict them, frames cannot."
            return _not_counted(term, "not compared", what)


def _not_counted(term: TermName, name: str, what: str) -> Judged:
    return Judged((Check(term, name, None, None, "", None, what),))


def _advice(failed: tuple[TermName, ...]) -> str:
    if failed:
        return f"Calibrate the rig again: {' and '.join(failed)} differ between the sessions; look below."
    return "Go on: the two sessions show the same rig."
