"""``udccal fit``: fits a captured session and writes a profile with its report."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from udccal.cli.options import DOUBTFUL, IterationLog, ProfilePath


def fit(
    context: typer.Context,
    session: Annotated[Path, typer.Argument(help="Folder of a captured session.")],
    profile: ProfilePath,
    log: IterationLog = None,
) -> None:
    """Fit all five terms of a captured session and write a profile with its report."""
    from udccal.cli.jobs.fit import fit_to_profile

    if not fit_to_profile(context.obj, session, profile, log):
        raise typer.Exit(DOUBTFUL)
