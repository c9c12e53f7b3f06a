"""``udccal demo``: the whole way on a simulated rig, from captures to a restored photograph, against the truth."""

from __future__ import annotations

from pathlib import Path

import typer

from udccal.cli.options import OutFolder, RigName, Seed


def demo(
    context: typer.Context, out: OutFolder = Path("udccal-demo"), seed: Seed = 0, rig: RigName = "lg55-reduced"
) -> None:
    """Calibrate a small simulated rig and restore a photograph seen through it: about three minutes on two cores."""
    from udccal.cli.jobs.demonstration import demonstrate

    demonstrate(context.obj, rig, out, seed)
