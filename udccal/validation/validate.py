"""Validation of a profile by a session: every term's captures predicted, and a verdict."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import final

from udccal.comparison.comparable import check_same_rig
from udccal.comparison.estimates import ORDER
from udccal.errors import MissingStepError, SessionError
from udccal.io.hashing import sha256_file
from udccal.profiles.profile import Profile
from udccal.profiles.store import check_profile
from udccal.result import FitStatus
from udccal.sessions.manifest import MANIFEST_NAME
from udccal.sessions.schema import TermName
from udccal.sessions.store import Session, check_session
from udccal.validation.backscatter import validate_backscatter
from udccal.validation.checks import Check, Judged, ZMap
from udccal.validation.geometry import validate_geometry
from udccal.validation.limits import ValidationLimits
from udccal.validation.noise import validate_noise
from udccal.validation.own import Fitted, fitted_steps
from udccal.validation.psf import validate_psf
from udccal.validation.wire import validate_wire

FORMAT, VERSION = "udccal-validation", 1
# Terms that are judged at the same time.
_AT_ONCE = 2


@final
@dataclass(frozen=True, eq=False)
class Validation:
    """Whether a profile predicts a session. docs/validate.md describes each number.

    Attributes:
        ok: whether every check that counts is within its limit.
        advice: one sentence that says what to do.
        own_terms: those that the profile fitted to these very captures: most of them then confirm nothing.
        partly_own_terms: those that the profile fitted to some of these captures, which confirm little.
        checks: of all terms, in their order.
    """

    format: str
    version: int
    rig: str
    ok: bool
    advice: str
    profile_created_at: str
    session_created_at: str
    session_sha256: str
    own_terms: tuple[TermName, ...]
    partly_own_terms: tuple[TermName, ...]
    checks: tuple[Check, ...]
    limits: ValidationLimits


def validate(profile: Profile, session: Session, limits: ValidationLimits | None = None) -> Validation:
    """Predict a session's captures with a profile's terms, without fitting these, and judge what is left.

    What belongs to the captures alone is solved for: level, colour and slow change of a flat's light, place and light
    of an LED, pose of a board.

    Args:
        profile: of the same rig and camera.
        session: best one that the profile was not fitted to.
        limits: of the checks; None for those of docs/validate.md.

    Returns:
        every check with its value, its limit and one sentence.

    Raises:
        ProfileError: when the session is of another rig or camera.
        SessionError: when a file of the session is missing or damaged, or no term can be judged.
        FitError: when frames or boards are not what a fit takes.
    """
    check_profile(profile)
    check_session(session)
    return judge(profile, session, limits or ValidationLimits())[0]


def judge(
    profile: Profile,
    session: Session,
    limits: ValidationLimits,
    progress: Callable[[TermName], None] = lambda term: None,
) -> tuple[Validation, Mapping[TermName, ZMap]]:
    """Validate, and keep the maps for figures; see ``validate``. ``progress`` gets each term when it begins."""
    check_same_rig(profile, session.rig, session.camera)
    sha256 = sha256_file(session.path / MANIFEST_NAME)
    same_session = sha256 == profile.provenance.session_sha256
    fitted = {term: fitted_steps(profile.result(term), session.steps(term), same_session) for term in ORDER}
    own, partly = tuple(t for t in ORDER if fitted[t].whole), tuple(t for t in ORDER if fitted[t].partly)

    def one(term: TermName) -> Judged:
        progress(term)
        return _judged(term, profile, session, limits, fitted[term])

    with ThreadPoolExecutor(_AT_ONCE) as pool:
        judged = dict(zip(ORDER, pool.map(one, ORDER), strict=True))
    checks = tuple(check for one in judged.values() for check in one.checks)
    counted = [check for check in checks if check.ok is not None]
    if not counted:
        raise SessionError(
            f"Expected a session with captures of a term that the profile measured, found none in {session.path}. "
            "Capture some steps of the rig first."
        )
    failed = tuple(dict.fromkeys(check.term for check in counted if not check.ok))
    answer = Validation(
        format=FORMAT,
        version=VERSION,
        rig=profile.rig.name,
        ok=not failed,
        advice=_advice(failed, own, partly, tuple(dict.fromkeys(check.term for check in counted))),
        profile_created_at=profile.provenance.created_at,
        session_created_at=session.manifest.created_at,
        session_sha256=sha256,
        own_terms=own,
        partly_own_terms=partly,
        checks=checks,
        limits=limits,
    )
    return answer, {term: one.z_map for term, one in judged.items() if one.z_map is not None}


def _judged(term: TermName, profile: Profile, session: Session, limits: ValidationLimits, fitted: Fitted) -> Judged:
    if not session.steps(term):
        return _not_counted(term, "NOT_CAPTURED", "The session has no captures of this term.")
    if profile.result(term).status is FitStatus.NOT_CAPTURED:
        return _not_counted(
            term, "NOT_CAPTURED", "The profile has no captures of this term: there is nothing to judge."
        )
    try:
        found = _predicted(term, profile, session, limits, fitted.count > 0)
    except MissingStepError as error:
        return _not_counted(term, "NOT_CAPTURED", f"The session has captures of a part of this term. {error}")
    return replace(found, checks=(*found.checks, _partly_own(term, fitted))) if fitted.partly else found


def _predicted(term: TermName, profile: Profile, session: Session, limits: ValidationLimits, own: bool) -> Judged:
    match term:
        case "noise":
            return validate_noise(profile, session, limits)
        case "geometry":
            return validate_geometry(profile, session, limits)
        case "wire":
            return validate_wire(profile, session, limits)
        case "psf":
            return validate_psf(profile, session, limits, own)
        case "backscatter":
            return validate_backscatter(profile, session, limits)


def _not_counted(term: TermName, name: str, what: str) -> Judged:
    return Judged((_remark(term, name, what),))


def _remark(term: TermName, name: str, what: str) -> Check:
    return Check(term, name, None, None, "", None, what)


def _partly_own(term: TermName, fitted: Fitted) -> Check:
    what = (
        f"The profile was fitted to {fitted.count} of the {fitted.steps} steps of this term in the session: these "
        "confirm little."
    )
    return _remark(term, "captures of the profile's fit", what)


def _advice(
    failed: tuple[TermName, ...],
    own: tuple[TermName, ...],
    partly: tuple[TermName, ...],
    counted: tuple[TermName, ...],
) -> str:
    if failed:
        terms = " and ".join(failed)
        return (
            f"Do not rely on {terms} of this profile for captures like these: calibrate the rig again, or look below."
        )
    known, how = (*own, *partly), ", at least in part, those" if partly else " the ones"
    if others := [term for term in counted if term not in known]:
        if not known:
            return "Go on with this profile: it predicts the session's captures."
        return (
            f"Go on with this profile: it predicts the session's captures of {' and '.join(others)}. Those of "
            f"{' and '.join(known)} are{how} that it was fitted to, and confirm little."
        )
    captures = "captures that are, at least in part, those" if partly else "the captures"
    return f"The profile describes {captures} that it was fitted to; capture others to confirm it."
