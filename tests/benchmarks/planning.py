"""Planned against obtained: what ``udccal plan`` foretells at two designs of a reduced rig, and what fits then state.

    python -m tests.benchmarks.planning [--out DIR] [--term NAME ...]

Both designs are captured on the simulated rig and fitted. The fits of the first design are the profile at whose values
both are predicted: at the first the prediction is of what was just measured, at the second it has to scale. Sigmas by
noise are compared: how far a model is off is estimated anew by every fit, and a plan takes it from the profile.
Writes DIR/planning.json and DIR/planning.md; exits with 1 where a prediction is off by more than 15 %.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import final, get_args

import numpy as np

from tests.benchmarks.rows import Row, table, write_json
from udccal.cli.jobs.benches import simulated_bench, simulated_rig
from udccal.cli.jobs.capture import capture
from udccal.cli.output import Output
from udccal.displays.pictures import face_picture
from udccal.fitting.backscatter import problem_of
from udccal.fitting.backscatter_data import read_shots as read_pictures
from udccal.fitting.backscatter_data import visible_crop
from udccal.fitting.backscatter_light import predict_light
from udccal.fitting.backscatter_report import known_from
from udccal.fitting.backscatter_select import choose
from udccal.fitting.calibrate import Calibration, FitEffort, fit_session
from udccal.fitting.geometry import projection_sigma_px
from udccal.fitting.psf import fit_shots_fully, window_half
from udccal.fitting.psf_posterior import psf_sigma
from udccal.fitting.psf_read import read_shots as read_leds
from udccal.models.psf import psf_kernels
from udccal.numerics import in_float64
from udccal.planning.measured import Measured, measured_state
from udccal.planning.predictors import predictor_for
from udccal.planning.state import Unexplained, sensor_samples
from udccal.rig import Captures, RigDescription, load_rig
from udccal.sessions.schema import TermName
from udccal.sessions.store import Session

MOST_OFF = 0.15
_RIG = "lg55-reduced"
_NEW_PICTURES = (9001, 9002, 9003)
_KERNEL = (89, 33)
OTHER = {
    "flats": 8,
    "noise_levels": 5,
    "psf_rows": 2,
    "psf_shifts": 2,
    "psf_exposures": 4,
    "backscatter_pictures": 12,
    "backscatter_frames": 2,
    "board_views": 12,
}


@final
@dataclass(frozen=True)
class Obtained:
    """A session of one design and its fits."""

    session: Session
    calibration: Calibration

    def sigma(self, term: TermName) -> float:
        """What the fit states, in the unit of the term's target."""
        match term:
            case "noise":
                K = self.calibration.foundation.noise.estimate("K_DN_per_e")
                return 100 * K.sigma / K.value
            case "geometry":
                places = sensor_samples(self.session.rig, 17)
                sigma = projection_sigma_px(self.calibration.foundation.geometry, places)
                return float(np.sqrt(np.mean(sigma**2)))
            case "wire":
                found = {item.name: item.value for item in self.calibration.foundation.wire.diagnostics}
                return float(np.sqrt(found["wire_map_rms_sigma"] ** 2 - found["wire_map_model_sigma"] ** 2))
            case "psf":
                return _psf_percent(self)
            case "backscatter":
                return _backscatter_percent(self)


def obtained(rig: RigDescription, folder: Path, seed: int = 0) -> Obtained:
    """Capture a rig in simulation (what the folder holds already is kept), and fit it."""
    with simulated_bench(simulated_rig(rig, seed)) as bench:
        capture(Output(), rig, bench, folder, get_args(TermName))
    session = Session.open(folder)
    return Obtained(session, fit_session(session))


@in_float64
def _psf_percent(made: Obtained) -> float:
    """Relative L2 of the stated sigmas at the places that the prediction looks at, root mean square."""
    base, session = made.calibration.foundation, made.session
    reading = read_leds(session, base.noise.term, base.wire.term, window_half(session, FitEffort().psf.half_px))
    if reading.shots is None:
        return float("inf")
    fit = fit_shots_fully(reading.shots, session.rig, base.geometry.term, base.wire.term)
    camera = session.rig.camera
    places = np.array([[0.45, 0.55], [0.15, 0.2], [0.85, 0.7]]) * [camera.columns, camera.rows]
    sigma = psf_sigma(replace(fit.posterior, model_error=0.0), places, *_KERNEL)
    kernel = np.asarray(psf_kernels(fit.result.term, places, *_KERNEL))
    relative = (sigma**2).sum(axis=(2, 3)) / (kernel**2).sum(axis=(2, 3))
    return 100 * float(np.sqrt(relative.mean()))


def _backscatter_percent(made: Obtained) -> float:
    """Stated sigma of pictures that were not shown, of their peak."""
    base, rig = made.calibration.foundation, made.session.rig
    geometry = base.geometry.term
    crop = visible_crop(geometry, rig)
    shots = read_pictures(made.session, base.noise.term, crop, base.wire_map)
    if shots is None:
        return float("inf")
    problem = problem_of(shots, geometry, rig, FitEffort().backscatter_positions)
    new = np.stack([crop.of(face_picture(seed, rig.panel.columns, rig.panel.rows)) for seed in _NEW_PICTURES])
    choice = choose(problem)
    known = replace(known_from(choice), share=0.0, cov=choice.state.fitted.solution.cov)
    light = predict_light(known, shots, new, problem.flat)
    peak = light.rate.max(axis=(1, 2))
    return 100 * float(np.sqrt((light.sigma**2).mean() / (peak**2).mean()))


def compared(term: TermName, designs: list[tuple[str, Captures, Obtained]]) -> list[Row]:
    """Predictions at the values of the first design's fits, a row per design."""
    first = designs[0][2]
    base, rest = first.calibration.foundation, first.calibration
    fits = Measured(base.noise, base.geometry, base.wire, rest.psf, rest.backscatter)
    state = measured_state(first.session.rig, fits)
    # A corner's scatter goes for its noise, whatever it comes from.
    by_noise = replace(state, unexplained=Unexplained(corner_px=state.unexplained.corner_px))
    predictor = predictor_for(term, by_noise)
    rows = []
    for name, captures, made in designs:
        predicted, found = predictor.sigma(captures), made.sigma(term)
        off = predicted / found - 1
        said = f"{term}, {name}: predicted {predicted:.3g}, obtained {found:.3g}"
        rows.append(Row(said, 100 * off, 100 * MOST_OFF, "%", abs(off) <= MOST_OFF))
    return rows


def main() -> int:
    """Run the check; the exit status is 0 when every prediction keeps the limit."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("planning"), help="folder for sessions and results")
    parser.add_argument("--term", action="append", choices=get_args(TermName), help="this term only; may be repeated")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    rig = load_rig(_RIG)
    other = rig.captures.model_copy(update=OTHER)
    designs = [
        (
            name,
            captures,
            obtained(rig.model_copy(update={"captures": captures}), options.out / f"session-{name.split()[-1]}"),
        )
        for name, captures in (("rig's own", rig.captures), ("other", other))
    ]
    rows = [row for term in options.term or get_args(TermName) for row in compared(term, designs)]
    print(table(rows))
    write_json(rows, options.out / "planning.json")
    (options.out / "planning.md").write_text(table(rows) + "\n", encoding="utf-8")
    return 0 if all(row.ok for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
