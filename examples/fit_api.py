"""Fit from Python: estimators take a session and return a term with its covariance, its status and how it was reached.

python examples/fit_api.py                # captures a toy session of a simulated sensor first
python examples/fit_api.py SESSION        # fits the noise term of a session of your own
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from udccal.cli.jobs.benches import simulated_bench, simulated_rig
from udccal.cli.jobs.capture import capture
from udccal.cli.output import Output
from udccal.fitting.noise import fit_noise, nominal_noise, read_noise
from udccal.models.noise import electrons, variance_e
from udccal.rig import RigDescription, load_rig
from udccal.sessions.store import Session


def toy_rig() -> RigDescription:
    """A shipped rig with a quarter of its sensor and few captures."""
    rig = load_rig("lg55-reduced")
    camera = rig.camera.model_copy(update={"columns": 256, "rows": 192})
    captures = rig.captures.model_copy(update={"noise_levels": 8, "noise_stack": 4})
    return rig.model_copy(update={"name": "toy", "camera": camera, "captures": captures})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("session", type=Path, nargs="?")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path = arguments.session
        if path is None:
            path = Path(folder) / "session"
            rig = toy_rig()
            with simulated_bench(simulated_rig(rig, seed=0)) as bench:
                capture(Output(), rig, bench, path, ("noise",))
        report(Session.open(path))


def report(session: Session) -> None:
    """Fit, look at the result, and use the term."""
    result = fit_noise(read_noise(session), nominal_noise(session.rig))
    print(f"{result.status.name}: {result.status.value}")
    for estimate in result.estimates:
        print(f"  {estimate.name:22} {estimate.value:12.5g} ± {estimate.sigma:.2g} {estimate.unit}")
    print(f"  reduced chi-squared {result.chi2_dof:.3f} over {result.samples} samples")

    noise = result.or_raise().term  # a bad status becomes a FitError that says what to do
    signal_e = float(electrons(noise, 1000.0))
    sigma_e = float(variance_e(noise, signal_e, 0.01)) ** 0.5
    print(f"A sample of 1000 DN at 10 ms is {signal_e:.0f} ± {sigma_e:.0f} electrons.")


if __name__ == "__main__":
    main()
