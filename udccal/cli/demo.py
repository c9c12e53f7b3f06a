"""``udccal demo``: captures, fits and restores on a simulated rig, and compares the results with the truth."""

from __future__ import annotations

from pathlib import Path

import typer

from udccal.cli.options import OutFolder, RigName, Seed


def demo(
    context: typer.Context, out: OutFolder = Path("udccal-demo"), seed: Seed = 0, rig: RigName = "lg55-reduced"
) -> None:
    """Calibrate a small simulated rig and restore a photograph seen through it: one to three minutes on two cores."""
    from udccal.cli.jobs.demonstration import demonstrate

    demonstrate(context.obj, rig, out, seed)
