"""`make drift`: does `udccal check` find what changed at simulated rigs, and leave untouched ones alone?

    python -m tests.benchmarks.drift [--rigs N] [--out DIR]

A rig is a specimen of the reduced mirror with a quarter of its pixels, so that two hundred take less than an hour. Each
specimen is calibrated once: its lens is the true one, as boards have too few pixels, and it has no psf, which a check
does not use. Then it is checked on twelve other days: untouched on six, and on the others changed in one way each, in a
direction or at a place of its own. Writes one file
per rig to DIR, which a second run goes on from, DIR/drift.json and the table of docs/drift.md; exits with 1 where a
number misses its limit.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from tests.benchmarks.commit import note_commit, noted_commit, this_commit
from tests.benchmarks.readme_tables import put_table
from tests.benchmarks.rows import Row, at_least, at_most, table, write_json
from udccal.benches.bench import simulate, simulated_bench
from udccal.benches.capture import capture
from udccal.compilation import keep_compilations
from udccal.drift.check import check_rig, short_rig
from udccal.profiles.profile import Profile, build_profile
from udccal.profiles.provenance import provenance_now
from udccal.profiles.store import read_profile, write_profile
from udccal.reports.true_values import true_geometry
from udccal.result import FitResult, FitStatus
from udccal.rig import RigDescription, load_rig
from udccal.sessions.manifest import MANIFEST_NAME
from udccal.sessions.store import Session
from udccal.simulation.disturbances import Disturbances, knock
from udccal.simulation.light import RigLight
from udccal.simulation.truth import RigTruth, draw_truth, rotation_matrix
from udccal.simulation.world import SimulatedWorld
from udccal.term_fits import TermFits

_PAGE = Path(__file__).resolve().parents[2] / "docs" / "drift.md"
_UNTOUCHED = "untouched"
_FIRST_DAY = 1000
# Each specimen's days: as many untouched as changed.
_DAYS = 12
_MOST_FALSE, _LEAST_CAUGHT, _LEAST_NAMED = 5.0, 95.0, 90.0
_KNOCK_MM, _TILT_DEG = 0.05, 0.2
_MOST_OFF_MM, _MOST_OFF_DEG = 0.01, 0.02

Changed = tuple[RigTruth, Disturbances]


def knocked(truth: RigTruth, rng: np.random.Generator) -> Changed:
    """Move the camera by 0.05 mm in some direction."""
    way = rng.normal(size=3)
    x, y, z = _KNOCK_MM * way / np.linalg.norm(way)
    return knock(truth, (float(x), float(y), float(z))), Disturbances()


def tilted(truth: RigTruth, rng: np.random.Generator) -> Changed:
    """Turn the camera by 0.2 degree about its x axis, up or down."""
    angle, optics = _TILT_DEG * float(rng.choice([-1.0, 1.0])), truth.optics
    turned = optics.R_panel_camera @ rotation_matrix(0, -np.deg2rad(angle))
    return replace(
        truth, optics=replace(optics, R_panel_camera=turned, tilt_deg=optics.tilt_deg + angle)
    ), Disturbances()


def smudged(truth: RigTruth, rng: np.random.Generator) -> Changed:
    """Take away 5 % of the light at some place."""
    camera = truth.description.camera
    x, y = rng.uniform(0.1, 0.9, 2) * (camera.columns, camera.rows)
    place = (float(x), float(y), 0.04 * camera.columns)
    return truth, Disturbances(smudge_fraction=0.05, smudge_px=place)


def dimmed(truth: RigTruth, rng: np.random.Generator) -> Changed:
    """Set the panel to 90 % of its brightness."""
    panel = truth.panel
    light = {name: 0.9 * getattr(panel, name) for name in ("leak_e_per_s", "reflection_e_per_s")}
    return replace(truth, panel=replace(panel, **light)), Disturbances()


def amplified(truth: RigTruth, rng: np.random.Generator) -> Changed:
    """Raise the sensor's gain by 2 %."""
    return replace(truth, sensor=replace(truth.sensor, K_DN_per_e=1.02 * truth.sensor.K_DN_per_e)), Disturbances()


def refocused(truth: RigTruth, rng: np.random.Generator) -> Changed:
    """Change the focal length by 1 %, as a lens does that is focused at another distance."""
    by, optics = 1 + 0.01 * float(rng.choice([-1.0, 1.0])), truth.optics
    return replace(truth, optics=replace(optics, fx_px=by * optics.fx_px, fy_px=by * optics.fy_px)), Disturbances()


# The changes by the names that ``udccal check`` gives them.
CHANGES: dict[str, Callable[[RigTruth, np.random.Generator], Changed]] = {
    "moved": knocked,
    "tilted": tilted,
    "smudge": smudged,
    "panel level": dimmed,
    "gain": amplified,
    "refocused": refocused,
}


def small_rig() -> RigDescription:
    """The reduced rig with half of its pixels across and down, and a panel little larger than what it sees."""
    rig = load_rig("lg55-reduced")
    camera, panel, mounting = rig.camera, rig.panel, rig.mounting
    sensor = {"columns": camera.columns // 2, "rows": camera.rows // 2, "pitch_um": 2 * camera.pitch_um}
    middle = {
        name: getattr(mounting, name).model_copy(update={"value": value})
        for name, value in (("panel_x_px", 120.0), ("panel_y_px", 60.0))
    }
    parts = {
        "name": "lg55-small",
        "camera": camera.model_copy(update=sensor),
        "panel": panel.model_copy(update={"columns": 240, "rows": 136}),
        "mounting": mounting.model_copy(update=middle),
    }
    return rig.model_copy(update=parts)


@dataclass(frozen=True)
class Specimen:
    """A calibrated rig, its truth with the captures of a check, and its light while nothing moves."""

    profile: Profile
    truth: RigTruth
    light: RigLight

    @classmethod
    def calibrated(cls, number: int, folder: Path) -> Specimen:
        """Calibrate the specimen, or read the profile that the folder holds."""
        rig, path = small_rig(), _kept(folder, number)
        if not path.exists():
            with tempfile.TemporaryDirectory() as place, simulate(rig, number) as bench:
                session = capture(Path(place) / "session", bench, ("noise", "wire", "backscatter"))
                write_profile(path, _fitted(session, draw_truth(rig, number)))
            note_commit(path)
        truth = draw_truth(short_rig(rig), number)
        return cls(read_profile(path), truth, RigLight(truth))


def _kept(folder: Path, number: int) -> Path:
    return folder / f"specimen_{number:02d}"


def _fitted(session: Session, truth: RigTruth) -> Profile:
    """The profile of a session, with the true lens."""
    fits = TermFits(session, None)
    fits.geometry = FitResult.failed("geometry", true_geometry(truth), FitStatus.IMPORTED)
    provenance = provenance_now(session.path / MANIFEST_NAME, session.camera)
    results = fits.noise, fits.geometry, fits.wire, fits.psf, fits.backscatter
    return build_profile(session.rig, provenance, *(one.or_raise() for one in results), fits.wire_map)


@dataclass(frozen=True)
class Trial:
    """One rig: what was done to it, what the check said, and the processor time of captures and check."""

    number: int
    specimen: int
    case: str
    verdict: str
    changed: list[str]
    moved_mm: float
    turned_deg: float
    cpu_s: float
    commit: str


def case_of(number: int) -> str:
    """What is done to a rig: nothing to every other one, the changes in turn to the rest."""
    return list(CHANGES)[number // 2 % len(CHANGES)] if number % 2 else _UNTOUCHED


def run_trial(number: int, specimen: Specimen) -> Trial:
    """Change the rig, capture as ``udccal check`` does, and compare."""
    case, rng, begun = case_of(number), np.random.default_rng([number, 0xD21F7]), time.process_time()
    truth, disturbed = (specimen.truth, Disturbances()) if case == _UNTOUCHED else CHANGES[case](specimen.truth, rng)
    world = SimulatedWorld(truth, disturbed, seed=_FIRST_DAY + number)
    if truth.optics is specimen.truth.optics and truth.panel is specimen.truth.panel:
        world.light = specimen.light
    with tempfile.TemporaryDirectory() as folder, simulated_bench(world) as bench:
        session = capture(Path(folder) / "session", bench, ("wire", "backscatter"))
        found = check_rig(specimen.profile, session)[0]
    size = {one.name: one.value for one in found.changes}
    return Trial(
        number=number,
        specimen=truth.seed,
        case=case,
        verdict=found.verdict,
        changed=list(found.changed),
        moved_mm=size["moved"],
        turned_deg=size["tilted"],
        cpu_s=round(time.process_time() - begun, 2),
        commit=this_commit(),
    )


def judged(trials: list[Trial]) -> list[Row]:
    """False alarms of untouched rigs, by change how many were caught and named, and errors of movements."""
    alone = [one for one in trials if one.case == _UNTOUCHED]
    rows = [
        at_most(
            f"false alarms, of {len(alone)} untouched",
            _percent([one.verdict != "same" for one in alone]),
            _MOST_FALSE,
            "%",
        )
    ]
    for name in CHANGES:
        some = [one for one in trials if one.case == name]
        if some:
            caught, named = ([one.verdict == "changed" for one in some], [one.changed == [name] for one in some])
            rows.append(at_least(f"{name}: caught, of {len(some)}", _percent(caught), _LEAST_CAUGHT, "%"))
            rows.append(at_least(f"{name}: named and nothing else", _percent(named), _LEAST_NAMED, "%"))
    for name, found, true, most, unit in (
        ("moved", "moved_mm", _KNOCK_MM, _MOST_OFF_MM, "mm"),
        ("tilted", "turned_deg", _TILT_DEG, _MOST_OFF_DEG, "°"),
    ):
        off = [abs(getattr(one, found) - true) for one in trials if one.case == name]
        rows.append(at_most(f"{name}: size found, worst error", max(off, default=float("nan")), most, unit))
    return rows


def main() -> int:
    """Run what is missing of the trials; the exit status is 0 when every number keeps its limit."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rigs", type=int, default=200)
    parser.add_argument("--out", type=Path, default=Path("drift"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    keep_compilations()
    trials: list[Trial] = []
    specimen: Specimen | None = None
    for number in range(options.rigs):
        file = options.out / f"rig_{number:03d}.json"
        if not file.exists():
            if specimen is None or specimen.truth.seed != number // _DAYS:
                specimen = Specimen.calibrated(number // _DAYS, options.out)
            file.write_text(json.dumps(asdict(run_trial(number, specimen)), indent=1) + "\n", encoding="utf-8")
        one = Trial(**json.loads(file.read_text(encoding="utf-8")))
        trials.append(one)
        print(f"{number}: {one.case}: {one.verdict} {one.changed}, {one.cpu_s:.1f} s of processor time", flush=True)
    rows = judged(trials)
    write_json(rows, options.out / "drift.json")
    print(table(rows))
    specimens = {noted_commit(_kept(options.out, one.specimen)) for one in trials}
    put_table(_PAGE, "drift", table(rows), [*specimens, *(one.commit for one in trials)])
    return 0 if all(row.ok for row in rows) else 1


def _percent(flags: list[bool]) -> float:
    return 100 * float(np.mean(flags)) if flags else float("nan")


if __name__ == "__main__":
    sys.exit(main())
