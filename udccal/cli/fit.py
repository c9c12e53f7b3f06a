"""``udccal fit``: fits a captured session and writes a profile with its report."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from udccal.cli.options import DOUBTFUL, IterationLog, ProfilePath, TermChoice


def fit(
    context: typer.Context,
    session: Annotated[Path, typer.Argument(help="Folder of a captured session.")],
    profile: ProfilePath,
    term: Annotated[
        list[TermChoice] | None,
        typer.Option("--term", help="Fit this term only, and keep the profile's others; may be given again."),
    ] = None,
    log: IterationLog = None,
) -> None:
    """Fit all five terms of a captured session, or some of them again, and write a profile with its report."""
    from udccal.sessions.store import Session

    Session.open(session)  # one that cannot be read is refused before the seconds that loading the fits takes
    from udccal.cli.jobs.fit import fit_to_profile

    if not fit_to_profile(context.obj, session, profile, log, [one.value for one in term or ()]):
        raise typer.Exit(DOUBTFUL)
