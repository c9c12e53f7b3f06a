"""From a rig to a restored picture in Python: capture, fit, compute a sigma, write a profile, restore.

python examples/fit_api.py                # a toy session of a simulated sensor: its noise
python examples/fit_api.py SESSION OUT    # a whole session of your own, to a profile
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np

import udccal
from udccal.models.noise import electrons


def toy_rig() -> udccal.RigDescription:
    """Return a shipped rig with a quarter of its sensor and few captures."""
    rig = udccal.load_rig("lg55-reduced")
    camera = rig.camera.model_copy(update={"columns": 256, "rows": 192})
    captures = rig.captures.model_copy(update={"noise_levels": 8, "noise_stack": 4})
    return rig.model_copy(update={"name": "toy", "camera": camera, "captures": captures})


def report(result: udccal.FitResult) -> None:
    """Print what a fit found, and what to do where it failed."""
    print(f"{result.name}: {result.status.name}: {result.status.value}")
    for estimate in result.estimates:
        print(f"  {estimate.name:22} {estimate.value:12.5g} ± {estimate.sigma:.2g} {estimate.unit}")


def main(arguments: list[str]) -> None:
    if len(arguments) == 2:
        calibration = udccal.calibrate(udccal.Session.open(arguments[0]))
        for result in calibration.results:
            report(result)
        print(f"Wrote {calibration.or_raise().write(arguments[1])}")
        return
    with tempfile.TemporaryDirectory() as folder, udccal.simulate(toy_rig(), seed=0) as bench:
        session = udccal.capture(Path(folder) / "session", bench, terms=["noise"])
        noise = udccal.fit(session, "noise")
    report(noise)
    sigma = float(noise.sigma_of(lambda term: np.asarray(electrons(term, 1000.0))))
    print(f"A sample of 1000 DN is {float(electrons(noise.or_raise().term, 1000.0)):.1f} ± {sigma:.1f} electrons.")


if __name__ == "__main__":
    main(sys.argv[1:])
