"""A rig small enough for tests: the reduced mirror with the middle of its sensor only."""

from __future__ import annotations

from udccal.rig import RigDescription, load_rig
from udccal.simulation.truth import RigTruth, draw_truth


def toy_rig() -> RigDescription:
    rig = load_rig("lg55-reduced")
    camera = rig.camera.model_copy(update={"columns": 128, "rows": 96})
    captures = rig.captures.model_copy(
        update={"psf_columns": 3, "psf_rows": 2, "psf_region_columns": 24, "psf_region_rows": 48}
    )
    panel = rig.panel.model_copy(update={"columns": 1100, "rows": 400})
    return rig.model_copy(update={"camera": camera, "captures": captures, "panel": panel})


def toy_truth(seed: int = 0) -> RigTruth:
    return draw_truth(toy_rig(), seed)
