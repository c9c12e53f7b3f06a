"""Validates a profile by a session, prints the checks, and writes them as JSON and as a page."""

from __future__ import annotations

import json
from pathlib import Path

from udccal.cli.output import Output, plain
from udccal.compilation import keep_compilations
from udccal.io.atomic import write_atomically
from udccal.io.out_folder import check_writable, storing_in
from udccal.profiles.store import load_profile
from udccal.reports.page import write_page
from udccal.reports.validation_page import validation_page
from udccal.reports.validation_tables import checks_table
from udccal.sessions.store import Session
from udccal.validation.limits import ValidationLimits
from udccal.validation.validate import judge


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
        UdccalError: when ``out`` cannot be written to; this is found before any work.
    """
    keep_compilations()
    if out is not None:
        check_writable(out)
    profile, captured = load_profile(path), Session.open(session)
    with output.stage("validating"):
        found, maps = judge(profile, captured, ValidationLimits())
    output.answer(found.advice)
    output.table(checks_table(found.checks))
    for check in found.checks:
        if not check.ok:
            output.answer(f"{check.term}: {check.what}")
    if out is not None:
        with output.stage("report"), storing_in(out):
            write_page(out / "validation.html", validation_page(found, maps))
            document = json.dumps(plain(found), indent=2, allow_nan=False).encode() + b"\n"
            write_atomically(out / "validation.json", document)
        output.say(f"Written: {out / 'validation.html'} and {out / 'validation.json'}")
    output.result(found)
    return found.ok
