"""What a user would take instead, continued: libraries that udccal does not depend on, in their own environments.

They are given what the ways of ``instead`` are given that deblur: the demosaiced frame over the wire, less the panel's
light, and the exact kernels. Their time is that of the deblurring alone: reading, demosaicing and what depends on the
kernels alone is not counted.
"""

from __future__ import annotations

import math
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Float32

from tests.benchmarks.pareto.instead import Peer, Rgb, demosaiced
from tests.benchmarks.pareto.restoring import Taken
from tests.benchmarks.pareto.runs import Sight
from tests.benchmarks.peers.run import python_of
from udccal.restoration.metrics import psnr
from udccal.restoration.runtime import Restorer

_SCRIPT: Final = Path(__file__).with_name("by_others.py")
_LIMIT_S: Final = 1800


@dataclass(frozen=True)
class Other:
    """A library: how the tables name it, its name for the script, and its environment of the works' setup.sh."""

    name: str
    library: str
    environment: str

    def python(self, environments: Path) -> Path:
        """The interpreter of its environment, which need not be there."""
        return Path(python_of(self.environment, environments))


OTHERS: Final = (
    Other("regularizepsf: transform of patches", "regularizepsf", "regpsf"),
    Other("deepinv: space-varying blur, ADMM with total variation", "deepinv", "torch"),
)


def others_of(restorer: Restorer, sights: Sequence[Sight], environments: Path) -> list[Peer]:
    """Measure every library on some sights; of strengths, the one that is best for the mean of them is kept.

    Args:
        restorer: of the tier fast: it has the view, the wire, the panel's light and the kernels.
        sights: of the nineteen, the panel's picture known.
        environments: folder of the libraries' environments. One that is absent has not run.
    """
    found = []
    for other in OTHERS:
        name, python = f"{other.name} ({len(sights)} scenes)", other.python(environments)
        found.append(_peer(name, other, python, restorer, sights) if python.is_file() else Peer(name, (), math.nan))
    return found


def _peer(name: str, other: Other, python: Path, restorer: Restorer, sights: Sequence[Sight]) -> Peer:
    assert restorer.sharpener is not None
    grid, first_row = restorer.sharpener.grid, restorer.rows.start
    pictures = [_given(restorer, sight.taken) for sight in sights]
    most = [float(picture.max()) for picture in pictures]
    with tempfile.TemporaryDirectory() as folder:
        given, result = Path(folder) / "in.npz", Path(folder) / "out.npz"
        scaled = np.stack([picture / np.float32(peak) for picture, peak in zip(pictures, most, strict=True)])
        # Kernels lie on the sensor, pictures begin at the strip's first row.
        np.savez(given, pictures=scaled, x_px=grid.x_px, y_px=grid.y_px - first_row, kernels=grid.kernels)
        command = [str(python), str(_SCRIPT), other.library, str(given), str(result)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=_LIMIT_S, check=False)
        if done.returncode != 0:
            print(f"{name}: {(done.stderr.strip().splitlines() or ['failed'])[-1]}", file=sys.stderr)
            return Peer(name, (math.nan,), math.nan)
        with np.load(result) as stored:
            restored, seconds = stored["restored"], stored["seconds"]
    rectified = restorer.rectification.from_row(first_row)

    def dB(sight: Sight, picture: Rgb, peak: float) -> float:
        light = rectified.apply(np.ascontiguousarray(picture)) * np.float32(peak / sight.taken.exposure_s)
        return psnr(sight.after(light), sight.truth)

    tried = [tuple(map(dB, sights, own, most)) for own in restored]
    best = int(np.argmax([np.mean(each) for each in tried]))
    return Peer(name, tried[best], 1e3 * statistics.median(seconds[best].tolist()))


def _given(restorer: Restorer, taken: Taken) -> Float32[np.ndarray, "rows columns 3"]:
    """The frame over the wire, less the panel's light, demosaiced."""
    signal = restorer.scene_light(taken.frame, taken.exposure_s, taken.panel_picture).signal_e
    return demosaiced(signal, restorer.rig.camera.cfa)
