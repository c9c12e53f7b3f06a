"""`make drift`: does `udccal check` find what changed at simulated rigs, and leave untouched ones alone?

    python -m tests.benchmarks.drift [--rigs N] [--out DIR] [--rig NAME]

Half of the rigs are untouched; the others have one change each, in turn. A rig is the specimen of the shipped profile
on another day: with other noise, and changed in a direction or at a place of its own. Writes one file per rig to DIR,
which a second run goes on from, DIR/drift.json and the table of docs/check.md; exits with 1 where a number misses its
limit.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from tests.benchmarks.commit import this_commit
from tests.benchmarks.readme_tables import put_table
from tests.benchmarks.rows import Row, at_least, at_most, table, write_json
from udccal.benches.bench import simulated_bench
from udccal.benches.capture import capture
from udccal.compilation import keep_compilations
from udccal.drift.check import check_rig
from udccal.drift.short import short_rig
from udccal.profiles.profile import Profile
from udccal.profiles.store import load_profile
from udccal.simulation.disturbances import Disturbances, knock
from udccal.simulation.truth import RigTruth, draw_truth, rotation_matrix
from udccal.simulation.world import SimulatedWorld

_PAGE = Path(__file__).resolve().parents[2] / "docs" / "check.md"
_UNTOUCHED = "untouched"
_FIRST_DAY = 1000
_MOST_FALSE, _LEAST_CAUGHT, _LEAST_NAMED = 5.0, 95.0, 90.0

Changed = tuple[RigTruth, Disturbances]


def knocked(truth: RigTruth, rng: np.random.Generator) -> Changed:
    """Move the camera by 0.05 mm in some direction."""
    way = rng.normal(size=3)
    x, y, z = 0.05 * way / np.linalg.norm(way)
    return knock(truth, (float(x), float(y), float(z))), Disturbances()


def tilted(truth: RigTruth, rng: np.random.Generator) -> Changed:
    """Turn the camera by 0.2 degree about its x axis, up or down."""
    angle, optics = 0.2 * float(rng.choice([-1.0, 1.0])), truth.optics
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


@dataclass(frozen=True)
class Trial:
    """One rig: what was done to it, and what the check said."""

    number: int
    case: str
    verdict: str
    changed: list[str]
    moved_mm: float
    turned_deg: float
    commit: str


def case_of(number: int) -> str:
    """What is done to a rig: nothing to every other one, the changes in turn to the rest."""
    return list(CHANGES)[number // 2 % len(CHANGES)] if number % 2 else _UNTOUCHED


def run_trial(number: int, profile: Profile) -> Trial:
    """Change the rig, capture as ``udccal check`` does, and compare."""
    case, rng = case_of(number), np.random.default_rng([number, 0xD21F7])
    truth = draw_truth(short_rig(profile.rig), 0)
    truth, disturbed = (truth, Disturbances()) if case == _UNTOUCHED else CHANGES[case](truth, rng)
    world = SimulatedWorld(truth, disturbed, seed=_FIRST_DAY + number)
    with tempfile.TemporaryDirectory() as folder, simulated_bench(world) as bench:
        session = capture(Path(folder) / "session", bench, ("wire", "backscatter"))
        found = check_rig(profile, session)[0]
    size = {one.name: one.value for one in found.changes}
    return Trial(number, case, found.verdict, list(found.changed), size["moved"], size["tilted"], this_commit())


def judged(trials: list[Trial]) -> list[Row]:
    """False alarms of untouched rigs, and by change how many were caught and named."""
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
    return rows


def main() -> int:
    """Run what is missing of the trials; the exit status is 0 when every number keeps its limit."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rigs", type=int, default=200)
    parser.add_argument("--out", type=Path, default=Path("drift"))
    parser.add_argument("--rig", default="lg55-reduced", help="a rig whose shipped profile is that of specimen 0")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    keep_compilations()
    profile, trials = load_profile(options.rig), []
    for number in range(options.rigs):
        file = options.out / f"rig_{number:03d}.json"
        if not file.exists():
            file.write_text(json.dumps(asdict(run_trial(number, profile)), indent=1) + "\n", encoding="utf-8")
        trials.append(Trial(**json.loads(file.read_text(encoding="utf-8"))))
        print(f"{number}: {trials[-1].case}: {trials[-1].verdict} {trials[-1].changed}", flush=True)
    rows = judged(trials)
    write_json(rows, options.out / "drift.json")
    print(table(rows))
    put_table(_PAGE, f"drift {options.rig}", table(rows), [one.commit for one in trials])
    return 0 if all(row.ok for row in rows) else 1


def _percent(flags: list[bool]) -> float:
    return 100 * float(np.mean(flags)) if flags else float("nan")


if __name__ == "__main__":
    sys.exit(main())
