"""A program that starts, restores one frame and says so: `starts` measures how long that takes.

    python -m tests.benchmarks.pareto.first_picture PROFILE TIER KEEP FRAME

KEEP is the folder of prepared arrays, FRAME a file of ``write_frame``.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from jaxtyping import UInt8, UInt16

from udccal.compilation import keep_compilations
from udccal.restoration.runtime import Restorer
from udccal.restoration.tone import Tone
from udccal.tiers import Tier


def write_frame(
    path: Path,
    frame: UInt16[np.ndarray, "rows columns"],
    exposure_s: float,
    panel_picture: UInt8[np.ndarray, "panel_rows panel_columns 3"],
) -> None:
    """Write a frame, its exposure and the panel's picture."""
    np.savez(path, frame=frame, exposure_s=exposure_s, panel_picture=panel_picture)


def main() -> None:
    """Do as `udccal restore` does: keep compilations and prepared arrays."""
    profile, tier, keep, file = sys.argv[1:]
    keep_compilations()
    restorer = Restorer.load(profile, Tier(tier), keep=Path(keep))
    with np.load(file) as stored:
        frame, exposure_s, panel_picture = stored["frame"], float(stored["exposure_s"]), stored["panel_picture"]
    restorer.display(frame, exposure_s, Tone(1e-6), panel_picture)
    print("restored", flush=True)


if __name__ == "__main__":
    main()
