"""The shipped profile against calibrations of the same specimen on other days, after nothing, a knock and a turn.

    python -m tests.benchmarks.other_days --out DIR

Writes the tables of docs/diff.md, docs/validate.md and docs/check.md and the example of README. Needs the shared
photographs (../shared/data). Sessions and profiles in DIR are kept; a second run takes them from there. The exit status
is 0 when every number keeps its limit.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from tests.benchmarks.commit import note_commit, noted_commit, this_commit
from tests.benchmarks.full_blur import BLUR_GRID, build_full_blur
from tests.benchmarks.pictures import PictureBench
from tests.benchmarks.readme_tables import put_table
from tests.benchmarks.rows import Row, at_least, at_most, table
from tests.benchmarks.scenes import shared_scenes
from udccal.benches.bench import simulated_bench
from udccal.benches.capture import capture
from udccal.calibration import calibrate
from udccal.comparison.diff import ProfileDiff, diff
from udccal.comparison.movement import Moved
from udccal.comparison.term_diff import TermDiff
from udccal.compilation import keep_compilations
from udccal.drift.check import check_rig, short_rig
from udccal.drift.update import updated
from udccal.profiles.profile import Profile
from udccal.profiles.store import load_profile, read_profile
from udccal.restoration.runtime import Restorer
from udccal.rig import load_rig
from udccal.rig_folders import shipped_rig_folder
from udccal.sessions.store import Session
from udccal.simulation.disturbances import knock
from udccal.simulation.truth import RigTruth, draw_truth, rotation_matrix
from udccal.simulation.world import SimulatedWorld
from udccal.validation.validate import Validation, validate

_ROOT = Path(__file__).resolve().parents[2]
_RIG, _SPECIMEN, _DAY, _CHECK_DAY = "lg55-reduced", 0, 1, 2
_UPDATE_DB = 0.05
_EVERY_SCENE = 4


def _turned(truth: RigTruth) -> RigTruth:
    moved = knock(truth, (0.0, 0.0, -0.1))
    turn = moved.optics.R_panel_camera @ rotation_matrix(0, -np.deg2rad(0.2))
    return replace(moved, optics=replace(moved.optics, R_panel_camera=turn, tilt_deg=moved.optics.tilt_deg + 0.2))


KNOCK = "0.05 mm along x"
CASES: dict[str, Callable[[RigTruth], RigTruth]] = {
    "nothing": lambda truth: truth,
    KNOCK: lambda truth: knock(truth, (0.05, 0.0, 0.0)),
    "0.1 mm along −z and 0.2° of tilt": _turned,
}


def session_of(truth: RigTruth, folder: Path) -> Session:
    """Return the captures of another day, which the folder may hold from before."""
    with simulated_bench(SimulatedWorld(truth, seed=_DAY)) as bench:
        return capture(folder / "session", bench)


def profile_of(session: Session, folder: Path) -> Profile:
    """Return the fits of a session, which the folder may hold from before."""
    path = folder / "profile"
    if not path.exists():
        calibrate(session).or_raise().write(path)
        note_commit(path)
    return read_profile(path)


def line(case: str, found: ProfileDiff) -> str:
    """Return the row of a comparison."""
    moved = f"{_with_sigma(found.movement.distance, 4)} mm, {_with_sigma(found.movement.angle, 3)}°"
    return f"| {case} | {moved} | {', '.join(verdict(one) for one in found.terms)} |"


def verdict(term: TermDiff) -> str:
    """Return what has become of a term."""
    worst = term.worst
    return f"{term.term} {term.verdict} (χ² {term.chi2:.3g} of {term.dof}; {worst.name} {worst.value:.2g} {worst.unit})"


def _with_sigma(moved: Moved, digits: int) -> str:
    if moved.value is None or moved.sigma is None:
        raise ValueError(f"Expected sessions that determine the {moved.name}, found that no term does.")
    return f"{moved.value:.{digits}f} ± {moved.sigma:.{digits}f}"


def checks_table(found: Validation) -> str:
    """Return the checks of a validation that have a limit."""
    counted = [one for one in found.checks if one.limit is not None and one.value is not None]
    return table([at_most(f"{one.term}: {one.name}", one.value or 0.0, one.limit or 0.0, one.unit) for one in counted])


def update_rows(shipped: Profile, full: Profile, truth: RigTruth, folder: Path) -> list[Row]:
    """Check a rig that was knocked, and restore its scenes with the updated profile and with a full calibration's."""
    with simulated_bench(
        SimulatedWorld(replace(truth, description=short_rig(truth.description)), seed=_CHECK_DAY)
    ) as bench:
        session = capture(folder / "check", bench, ("wire", "backscatter"))
    found, solved = check_rig(shipped, session)
    new = updated(shipped, shipped_rig_folder() / _RIG / "profile", found, solved, session.path)
    moved = next(one for one in found.changes if one.name == "moved")
    old_dB, new_dB, full_dB = (_mean_dB(profile, truth) for profile in (shipped, new, full))
    print(f"scenes: old {old_dB:.3f}, updated {new_dB:.3f}, full {full_dB:.3f} dB", flush=True)
    return [
        at_most("movement found, error", abs(moved.value - 0.05), 0.01, "mm"),
        at_most(
            f"scenes: full calibration ({full_dB:.2f} dB) − updated profile ({new_dB:.2f} dB)",
            full_dB - new_dB,
            _UPDATE_DB,
            "dB",
        ),
        at_least(f"scenes: updated profile − old profile ({old_dB:.2f} dB)", new_dB - old_dB, 0.0, "dB"),
    ]


def _mean_dB(profile: Profile, truth: RigTruth) -> float:
    captures = truth.description.captures
    blur = build_full_blur(truth, *BLUR_GRID, captures.psf_region_rows + 1, captures.psf_region_columns + 1)
    bench = PictureBench(truth, blur, Restorer.from_profile(profile))
    shots = bench.shots(shared_scenes(_ROOT.parent / "shared" / "data", _EVERY_SCENE))
    return float(np.mean([bench.score(shot, 1.0).after_dB for shot in shots]))


def example(folder: Path) -> str:
    """Return what `udccal profile diff` prints for the knocked rig, as a block of a page."""
    udccal = Path(sys.executable).with_name("udccal")
    command = [udccal, "profile", "diff", _RIG, folder / "profile", "--out", folder / "difference"]
    environment = {**os.environ, "COLUMNS": "140", "TF_CPP_MIN_LOG_LEVEL": "3"}
    shown = subprocess.run(command, stdout=subprocess.PIPE, text=True, env=environment).stdout
    kept = (text.rstrip() for text in shown.splitlines() if not text.startswith("Written"))
    return "\n".join(["```", "$ udccal profile diff lg55-reduced after-a-knock --out difference", *kept, "```"])


def main() -> int:
    """Capture, fit, compare; write the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("other-days"))
    out: Path = parser.parse_args().out
    keep_compilations()
    shipped, truth = load_profile(_RIG), draw_truth(load_rig(_RIG), _SPECIMEN)
    folders = [out / str(number) for number in range(len(CASES))]
    truths = [change(truth) for change in CASES.values()]
    sessions = [session_of(one, folder) for one, folder in zip(truths, folders, strict=True)]
    profiles = [profile_of(session, folder) for session, folder in zip(sessions, folders, strict=True)]
    lines = [line(case, diff(shipped, one)) for case, one in zip(CASES, profiles, strict=True)]
    docs, knocked = _ROOT / "docs", list(CASES).index(KNOCK)
    commits = [this_commit(), *(noted_commit(folder / "profile") for folder in folders)]
    head = "| what was done to the rig | movement found | verdicts |\n| --- | --- | --- |\n"
    put_table(docs / "diff.md", "other days", head + "\n".join(lines), commits)
    put_table(docs / "validate.md", "other days", checks_table(validate(shipped, sessions[0])), commits)
    put_table(_ROOT / "README.md", "diff", example(folders[knocked]), commits)
    rows = update_rows(shipped, profiles[knocked], truths[knocked], folders[knocked])
    print("\n".join(lines), table(rows), sep="\n")
    put_table(docs / "check.md", "update", table(rows), commits)
    return 0 if all(row.ok for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
