"""Compares the forecast of ``udccal plan`` at two designs of a reduced rig with the sigma of the fits.

    python -m tests.benchmarks.planning [--out DIR] [--term NAME ...] [--realisations N]

Both designs are captured on the simulated rig and fitted. The fits of the first design are the profile at whose values
both are predicted: at the first the prediction is of what was just measured, at the second it has to scale. Sigmas by
noise are compared: every fit estimates its own model error, and a plan takes it from the profile. The psf
is compared in small windows of a rig whose light is in the class of its fit, and with the errors found, too.
Writes DIR/planning.json, and two tables in docs/planning.md: that of sessions when all their terms were asked for, and
that of the psf; exits with 1 where a prediction is off by more than 15 %.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import final, get_args

import numpy as np

from tests.benchmarks.planning_psf import Compared, compared_psf
from tests.benchmarks.readme_tables import put_table
from tests.benchmarks.rows import Row, table, write_json
from tests.scenes.backscatter import predicted_light
from udccal.benches.bench import simulated_bench, simulated_rig
from udccal.benches.capture import capture
from udccal.calibration import Calibration, calibrate
from udccal.compilation import keep_compilations
from udccal.displays.pictures import face_picture
from udccal.fitting.backscatter.posterior import TermAt, linear_cov
from udccal.fitting.backscatter.read import read_backscatter
from udccal.fitting.backscatter.search import search
from udccal.fitting.backscatter.solve import Problem
from udccal.fitting.geometry.fit import projection_sigma_px
from udccal.planning.forecast import PREDICTORS
from udccal.planning.state import ModelErrors, measured_state, sensor_samples
from udccal.rig import Captures, RigDescription, load_rig
from udccal.sessions.schema import TermName
from udccal.sessions.store import Session

MOST_OFF = 0.15
# Errors found in fewer fits than these tell nothing: their standard error widens the limit.
_ENOUGH = 12
_PAGE = Path(__file__).resolve().parents[2] / "docs" / "planning.md"
_OF_SESSIONS: tuple[TermName, ...] = ("noise", "geometry", "wire", "backscatter")
_RIG = "lg55-reduced"
_NEW_PICTURES = (9001, 9002, 9003)
OTHER = {
    "flats": 8,
    "noise_levels": 5,
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
        """Return the fit's sigma, in the unit of the term's target."""
        match term:
            case "noise":
                K = self.calibration.noise.estimate("K_DN_per_e")
                return 100 * K.sigma / K.value
            case "geometry":
                places = sensor_samples(self.session.rig, 17)
                sigma = projection_sigma_px(self.calibration.geometry, places)
                return float(np.sqrt(np.mean(sigma**2)))
            case "wire":
                found = {item.name: item.value for item in self.calibration.wire.diagnostics}
                return float(np.sqrt(found["wire_map_rms_sigma"] ** 2 - found["wire_map_model_sigma"] ** 2))
            case "backscatter":
                return _backscatter_percent(self)
            case "psf":
                raise ValueError("expected a term of a session, found the psf, which has scenes of its own")


def obtained(rig: RigDescription, folder: Path, seed: int = 0) -> Obtained:
    """Capture a rig in simulation (what the folder holds already is kept), and fit it."""
    with simulated_bench(simulated_rig(rig, seed)) as bench:
        capture(folder, bench, _OF_SESSIONS)
    session = Session.open(folder)
    return Obtained(session, calibrate(session))


def _backscatter_percent(made: Obtained) -> float:
    """Stated sigma of pictures that were not shown, of their peak."""
    base, rig = made.calibration.foundation, made.session.rig
    geometry = base.geometry.term
    data = read_backscatter(made.session, base.noise.term, geometry, base.wire_map)
    if not data.names:
        return float("inf")
    new = [face_picture(seed, rig.panel.columns, rig.panel.rows) for seed in _NEW_PICTURES]
    found = search(Problem.of(data, geometry, rig))
    # By noise alone.
    found = replace(found, model_error=0.0)
    posterior = TermAt.of(data, found).posterior(linear_cov(found, np.ones(len(found.fitted.found.x))))
    light = predicted_light(posterior.term_at(posterior.mean), posterior, 0.0, rig, new, found.problem.flat)
    peak = light.rate.max(axis=(1, 2))
    return 100 * float(np.sqrt((light.sigma**2).mean() / (peak**2).mean()))


def compared(term: TermName, designs: list[tuple[str, Captures, Obtained]]) -> list[Row]:
    """Predictions at the values of the first design's fits, a row per design."""
    first = designs[0][2]
    state = measured_state(first.session.rig, first.calibration)
    # A corner's scatter goes for its noise, whatever it comes from.
    known = state.model_errors
    by_noise = replace(state, model_errors=ModelErrors(on_jig_px=known.on_jig_px, by_hand_px=known.by_hand_px))
    predictor = PREDICTORS[term](by_noise)
    rows = []
    for name, captures, made in designs:
        rows.append(_row(f"{term}, {name}", predictor.sigma(captures), "stated", made.sigma(term)))
    return rows


def psf_rows(made: Compared) -> list[Row]:
    """Return the rows of one design: against the fits' own sigma, and against the errors found."""
    stated = _row(f"psf, {made.name}", made.predicted, "stated", made.stated)
    found = _row(f"psf, {made.name}", made.predicted, f"error found in {made.realisations} fits", made.obtained)
    # The error found has a standard error of its own.
    limit = 100 * (MOST_OFF + 2 * made.spread)
    return [stated, replace(found, limit=limit, ok=abs(found.value) <= limit)]


def _row(name: str, predicted: float, how: str, obtained: float) -> Row:
    off = predicted / obtained - 1
    said = f"{name}: predicted {predicted:.3g}, {how} {obtained:.3g}"
    return Row(said, 100 * off, 100 * MOST_OFF, "%", abs(off) <= MOST_OFF)


def session_rows(terms: list[TermName], out: Path) -> list[Row]:
    """Capture and fit both designs, and compare."""
    if not terms:
        return []
    rig = load_rig(_RIG)
    other = rig.captures.model_copy(update=OTHER)
    designs = [
        (
            name,
            captures,
            obtained(rig.model_copy(update={"captures": captures}), out / f"session-{name.split()[-1]}"),
        )
        for name, captures in (("rig's own", rig.captures), ("other", other))
    ]
    return [row for term in terms for row in compared(term, designs)]


def main() -> int:
    """Run the check; the exit status is 0 when every prediction keeps the limit."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("planning"), help="folder for sessions and results")
    parser.add_argument("--term", action="append", choices=get_args(TermName), help="this term only; may be repeated")
    parser.add_argument("--realisations", type=int, default=32, help="fits of each of the psf's designs")
    options = parser.parse_args()
    if options.realisations < _ENOUGH:
        parser.error(f"expected at least {_ENOUGH} realisations, found {options.realisations}")
    options.out.mkdir(parents=True, exist_ok=True)
    keep_compilations()
    terms: list[TermName] = options.term or list(get_args(TermName))
    of_sessions = session_rows([term for term in terms if term != "psf"], options.out)
    of_psf = [row for made in compared_psf(options.realisations) for row in psf_rows(made)] if "psf" in terms else []
    rows = [*of_sessions, *of_psf]
    print(table(rows))
    write_json(rows, options.out / "planning.json")
    if set(_OF_SESSIONS) <= set(terms):
        put_table(_PAGE, "planning", table(of_sessions))
    if of_psf:
        put_table(_PAGE, "planning psf", table(of_psf))
    return 0 if all(row.ok for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
