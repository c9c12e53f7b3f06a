"""Captures a short session of a rig, says what has changed since its profile, and writes it down."""

from __future__ import annotations

import json
import os
import shutil
import time
from pathlib import Path
from typing import Final

from udccal.benches.bench import CaptureBench
from udccal.cli.bench_options import BenchOptions
from udccal.cli.jobs.apart import check_profile_place
from udccal.cli.jobs.capture import Wanted
from udccal.cli.jobs.terminal import TerminalPerson
from udccal.cli.output import Output, plain
from udccal.comparison.comparable import check_same_rig
from udccal.compilation import keep_compilations
from udccal.drift.check import RigCheck, Solved, check_measured, check_rig, short_rig
from udccal.drift.update import updated
from udccal.errors import MissingStepError, ProfileError, SessionError
from udccal.io.atomic import write_atomically
from udccal.io.out_folder import check_writable, storing_in
from udccal.planned_steps import planned_ids
from udccal.profiles.profile import Profile
from udccal.profiles.store import check_outside_profiles, load_profile, write_profile
from udccal.reports.check_page import changes_table, check_page
from udccal.reports.page import write_page
from udccal.rig import RigDescription
from udccal.sessions.changes import stored_camera
from udccal.sessions.manifest import MANIFEST_NAME
from udccal.sessions.schema import TermName
from udccal.sessions.store import Session

_TERMS: Final[tuple[TermName, ...]] = ("wire", "backscatter")
# An interrupted check is gone on with on the same day.
_STALE_S = 24 * 3600.0


def check_profile(
    output: Output, path: Path, options: BenchOptions, agree: bool, out: Path, update: Path | None
) -> bool | None:
    """Capture, compare and print; return whether the rig is the same, or changed by less than matters.

    None when the person at the rig has stopped the capture.

    Args:
        output: shows the changes.
        path: folder or zip file of the profile, or a rig's name.
        options: where the rig is.
        agree: whether a capture that a person is led through goes on by itself wherever all is in order.
        out: folder for ``session``, ``check.json`` and ``check.html``.
        update: path of a new profile with what changed, written where a pose explains the flats; None for none.

    Raises:
        ProfileError: when the profile cannot be read, lacks a term that this needs, or is not of this rig and camera,
            or when ``update`` or ``out`` is among other files; each is found before a capture.
        CaptureError: when the camera does not see what a step needs.
        SessionError: when the captures cannot be stored or read.
        UdccalError: when ``out`` cannot be written to; this is found before any work.
    """
    keep_compilations()
    check_outside_profiles(out / "session")
    check_writable(out)
    if update is not None:
        _check_apart(update, out)
        check_profile_place(update)
    profile = load_profile(path)
    check_measured(profile)
    rig, folder = short_rig(profile.rig), out / "session"
    wanted = Wanted(folder, _TERMS, before=lambda bench: _begin(profile, bench, out))
    person = TerminalPerson(output) if options.led else None
    if not options.capture(output, rig, wanted, person, agree):
        return None
    with output.stage("comparing"):
        found, solved = _compared(profile, folder, out)
    output.answer(found.advice)
    output.table(changes_table(found))
    with storing_in(out):
        write_page(out / "check.html", check_page(found, solved))
        write_atomically(out / "check.json", json.dumps(plain(found), indent=2, allow_nan=False).encode() + b"\n")
    output.say(f"Written: {out / 'check.html'} and {out / 'check.json'}")
    if update is not None and not found.explained:
        output.say(f"No updated profile at {update}: no movement of the camera explains the flats.")
    elif update is not None:
        with storing_in(update.parent):
            write_profile(update, updated(profile, path, found, solved, folder))
        output.say(f"Updated profile: {update}")
    output.result(found)
    return found.verdict != "changed"


def _check_apart(update: Path, out: Path) -> None:
    """Refuse a profile's path that would replace the check's own files, or be replaced with them."""
    profile, check = (Path(os.path.abspath(path)) for path in (update, out))
    own = [check / name for name in ("session", "session-before", "session-pictures", "check.html", "check.json")]
    if profile in (check, *check.parents) or any(path in (profile, *profile.parents) for path in own):
        raise ProfileError(
            f"Expected the updated profile apart from the captures and results in {out}, found {update}. Give --update "
            f"another path, such as {out / 'profile'}."
        )


def _begin(profile: Profile, bench: CaptureBench, out: Path) -> None:
    """Put the captures of the last check aside, now that the rig of the profile is there for a new one."""
    check_same_rig(profile, bench.rig, stored_camera(bench.camera.identity))
    with storing_in(out):
        if (out / "check.json").exists() or _of_another_check(out / "session", bench.rig):
            _put_aside(out / "session")
        # They would else stay beside captures that they do not tell of.
        for file in (out / "check.html", out / "check.json"):
            file.unlink(missing_ok=True)


def _of_another_check(session: Path, rig: RigDescription) -> bool:
    """Whether captures are whole, or so old that the rig may have changed since; others are of a check to go on with.

    A check whose captures are whole has ended, be it that it could not compare them.
    """
    try:
        captured = {step.id for step in Session.open(session).manifest.steps}
    except SessionError:  # none, or one that the capture itself mends or refuses
        return False
    whole = all(captured.issuperset(planned_ids(term, rig)) for term in _TERMS)
    return whole or time.time() - (session / MANIFEST_NAME).stat().st_mtime > _STALE_S


def _compared(profile: Profile, session: Path, out: Path) -> tuple[RigCheck, Solved]:
    """Compare; captures that cannot be used are put aside, so that the next check does not go on with them.

    Where a step was left out, the others stay: the next check captures that step alone.
    """
    try:
        return check_rig(profile, Session.open(session))
    except MissingStepError:
        raise
    except SessionError:
        with storing_in(out):
            _put_aside(session)
        raise


def _put_aside(session: Path) -> None:
    """Keep captures as ``session-before``: a rig of today is not judged by them."""
    if session.is_dir():
        before = session.with_name("session-before")
        shutil.rmtree(before, ignore_errors=True)
        session.rename(before)
