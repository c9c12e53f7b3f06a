"""Fits a captured session and writes a profile and its report."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import final

from udccal.calibration import ORDER, Calibration, Foundation, calibrate
from udccal.cli.jobs.apart import check_profile_place
from udccal.cli.jobs.log_file import check_log, log_file
from udccal.cli.output import Output, StageTime
from udccal.compilation import compilation_clock, keep_compilations
from udccal.displays.pictures import face_picture
from udccal.effort import FitEffort
from udccal.errors import FitError
from udccal.fitting.engine.least_squares import LOG
from udccal.io.links import refuse_links
from udccal.io.out_folder import storing_in
from udccal.profiles.history import identity
from udccal.profiles.profile import Profile
from udccal.profiles.store import read_profile
from udccal.refit import refit
from udccal.reports.page import write_page
from udccal.reports.report import calibration_page, gather
from udccal.reports.tables import Table
from udccal.sessions.schema import TermName
from udccal.sessions.store import Session

# Seed of a picture that no calibration shows.
UNSEEN_PICTURE = 9001


@dataclass(frozen=True)
class TermSummary:
    """How one term's fit ended."""

    term: str
    status: str
    advice: str
    chi2_dof: float
    notes: tuple[str, ...]


@dataclass(frozen=True)
class FitSummary:
    """Result of ``fit`` and ``calibrate``; ``warnings`` are of terms in the profile whose fit did not end well."""

    session: Path
    profile: Path
    report: Path
    terms: tuple[TermSummary, ...]
    warnings: tuple[str, ...]
    times: tuple[StageTime, ...]
    compilation_s: float


def fit_to_profile(
    output: Output, session_path: Path, profile_path: Path, log: Path | None = None, terms: Sequence[TermName] = ()
) -> bool:
    """Fit a session, write the report and the profile, and print the summary; return whether every fit ended well.

    Args:
        output: shows stages and the summary.
        session_path: folder of the session.
        profile_path: folder or zip file to write; the report goes next to it.
        log: file that receives the solvers' iterations; None for none.
        terms: those to fit; the profile's others are kept. All where there are none.

    Raises:
        SessionError: when the session is missing or damaged.
        FitError: when a term has no error bars; then the report is written and the profile is not.
        ProfileError: when something else is at the profile's path, or a profile whose terms cannot be kept.
        UdccalError: when the profile's folder cannot be written to, or it or ``log`` is in a profile or a session; this
            is found before any work.
    """
    check_profile_place(profile_path, session_path)
    check_log(log, session_path, profile_path)
    before = read_profile(profile_path) if terms else None
    parent = identity(profile_path).sha256 if terms else None
    keep_compilations()
    clock = compilation_clock()
    session = Session.open(session_path)
    for change in session.manifest.changes:
        output.say(
            f"Careful: the {change.what} was exchanged during this session, from {change.before} to {change.after}. "
            "The fits treat all steps as captured with one."
        )
    with _iterations_to(output, log):
        calibration = run_fits(output, session) if before is None else run_some(output, session, before, terms)
    calibration = replace(calibration, parent=parent)
    profile_path = profile_path.resolve()
    report = profile_path.with_name(f"{profile_path.name.removesuffix('.zip')}-report.html")
    with output.stage("report"):
        panel = session.rig.panel
        unseen = face_picture(UNSEEN_PICTURE, panel.columns, panel.rows)
        evidence = gather(session, calibration, unseen, None)
        page = calibration_page(session, evidence, None)
        with storing_in(report.parent):
            write_page(report, page)
    show_status(output, calibration)
    try:
        store_profile(output, calibration, profile_path)
    except FitError as error:
        raise FitError(f"{error} No profile was written; the report {report} shows every term.") from error
    output.say(f"Compilation took {clock.seconds:.1f} s of this (less in the next run)")
    output.say(f"Profile: {profile_path}\nReport: {report}\n{page.advice.headline}")
    for sentence in page.advice.sentences:
        output.say(sentence)
    for warning in calibration.warnings:
        output.say(warning)
    ended, times = summaries(calibration), tuple(output.times)
    output.result(FitSummary(session_path, profile_path, report, ended, calibration.warnings, times, clock.seconds))
    return not calibration.warnings


@final
class _Lines(logging.Handler):
    """Gives each message of the solvers to what writes lines."""

    def __init__(self, write: Callable[[str], None]) -> None:
        super().__init__()
        self._write = write
        self.setFormatter(logging.Formatter("%(relativeCreated)9.0f ms  %(message)s"))

    def emit(self, record: logging.LogRecord) -> None:
        self._write(self.format(record))


@contextmanager
def _iterations_to(output: Output, path: Path | None) -> Iterator[None]:
    if path is None:
        yield
        return
    with storing_in(path.parent):
        path.parent.mkdir(parents=True, exist_ok=True)
        refuse_links(path.parent, path)
    with log_file(output, path, "iterations") as write:
        handler, level = _Lines(write), LOG.level
        LOG.addHandler(handler)
        LOG.setLevel(logging.DEBUG)
        try:
            yield
        finally:
            LOG.setLevel(level)
            LOG.removeHandler(handler)


def run_fits(
    output: Output, session: Session, effort: FitEffort | None = None, foundation: Foundation | None = None
) -> Calibration:
    """Run all five fits with a bar; those in ``foundation`` are done already."""
    with output.stage("fits") as stage:

        def progress(term: TermName) -> None:
            stage.update(ORDER.index(term), len(ORDER), f"fitting {term}")

        calibration = calibrate(session, progress, effort, foundation)
    for time in calibration.times:
        output.say(f"  {time.term}: {time.seconds:.1f} s")
    return calibration


def run_some(output: Output, session: Session, before: Profile, terms: Sequence[TermName]) -> Calibration:
    """Run the fits of some terms with a bar; the others are those of the session's profile ``before``."""
    with output.stage("fits") as stage:
        calibration = refit(session, before, terms, lambda term: stage.update(0, None, f"fitting {term}"))
    for time in calibration.times:
        output.say(f"  {time.term}: {time.seconds:.1f} s")
    return calibration


def store_profile(output: Output, calibration: Calibration, path: Path) -> None:
    """Write the profile of a calibration.

    Raises:
        FitError: when a term has no error bars.
        ProfileError: when something else is at ``path``.
        UdccalError: when it cannot be written.
    """
    with output.stage("profile"), storing_in(path.parent):
        calibration.write(path)


def summaries(calibration: Calibration) -> tuple[TermSummary, ...]:
    """Return how each term's fit ended."""
    results = ((term, calibration.result(term)) for term in ORDER)
    return tuple(TermSummary(t, r.status.name, r.status.value, r.chi2_dof, r.notes) for t, r in results)


def show_status(output: Output, calibration: Calibration) -> None:
    """Return a table with one line per term."""
    rows = tuple((s.term, s.status, f"{s.chi2_dof:.3f}", s.advice) for s in summaries(calibration))
    output.table(Table("Fits", ("term", "status", "reduced χ²", "what it means"), rows, frozenset({2})))
