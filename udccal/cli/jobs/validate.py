"""Validates a profile or a session by a session, prints the checks, and writes them as JSON and as a page."""

from __future__ import annotations

import json
from pathlib import Path

from udccal.cli.jobs.apart import check_folder_apart
from udccal.cli.output import Output, plain
from udccal.compilation import keep_compilations
from udccal.io.atomic import write_atomically
from udccal.io.out_folder import check_writable, storing_in
from udccal.profiles.store import load_profile
from udccal.reports.page import ValidationPage, write_page
from udccal.reports.validation_page import comparison_page, validation_page
from udccal.reports.validation_tables import checks_table
from udccal.sessions.store import Session
from udccal.validation.limits import ValidationLimits
from udccal.validation.sessions import SessionComparison, compared
from udccal.validation.validate import Validation, judge


def validate_profile(output: Output, path: Path, session: Path, out: Path | None) -> bool:
    """Print how a profile predicts a session; return whether every check is within its limit.

    Args:
        output: shows the checks.
        path: folder or zip file of the profile, or a rig's name.
        session: folder of the session.
        out: folder for ``validation.json`` and ``validation.html``; None for none.

    Raises:
        ProfileError: when the profile cannot be read, or is not of the session's rig.
        SessionError: when the session cannot be read, or no term of it can be judged.
        UdccalError: when ``out`` cannot be written to, or is in a profile or a session; this is found before any work.
    """
    keep_compilations()
    if out is not None:
        check_folder_apart(out)
        check_writable(out)
    profile, captured = load_profile(path), Session.open(session)
    with output.stage("validating"):
        found, maps = judge(profile, captured, ValidationLimits())
    _tell(output, found, validation_page(found, maps), out)
    return found.ok


def validate_session(output: Output, session: Path, against: Path, out: Path | None) -> bool:
    """Print how two sessions of one rig differ; return whether every check is within its limit.

    Args:
        output: shows the checks.
        session, against: folders of the sessions.
        out: folder for ``validation.json`` and ``validation.html``; None for none.

    Raises:
        SessionError: when a session cannot be read, or they cannot be compared.
        UdccalError: when ``out`` cannot be written to, or is in a profile or a session; this is found before any work.
    """
    if out is not None:
        check_folder_apart(out)
        check_writable(out)
    both = Session.open(session), Session.open(against)
    with output.stage("comparing"):
        found, maps = compared(*both, ValidationLimits())
    _tell(output, found, comparison_page(found, maps), out)
    return found.ok


def _tell(output: Output, found: Validation | SessionComparison, page: ValidationPage, out: Path | None) -> None:
    """Print the answer and the checks, and write them to a folder where there is one."""
    output.answer(found.advice)
    output.table(checks_table(found.checks))
    for check in found.checks:
        if not check.ok:
            output.answer(f"{check.term}: {check.what}")
    if out is not None:
        with output.stage("report"), storing_in(out):
            write_page(out / "validation.html", page)
            document = json.dumps(plain(found), indent=2, allow_nan=False).encode() + b"\n"
            write_atomically(out / "validation.json", document)
        output.say(f"Written: {out / 'validation.html'} and {out / 'validation.json'}")
    output.result(found)
