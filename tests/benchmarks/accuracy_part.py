"""One specimen of the accuracy table: calibrated, compared with its truth and, at full size, restored with.

    python -m tests.benchmarks.accuracy_part RIG-NUMBER DIR [--every N]

Writes DIR/part.json and, at full size, DIR/scenes.md and the worst scene's pictures. `make accuracy` runs this for
every specimen, each in a process of its own: the system counts what a parent holds to the peak memory of its child.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from tests.benchmarks.calibration_run import CalibrationRun, calibrate
from tests.benchmarks.commit import this_commit
from tests.benchmarks.draws import FULL, Draw
from tests.benchmarks.full_blur import BLUR_GRID, build_full_blur
from tests.benchmarks.pictures import CONDITIONS, Conditions, PictureBench, Score
from tests.benchmarks.rows import Row, at_least, at_most, table
from tests.benchmarks.scenes import shared_scenes
from tests.benchmarks.terms import term_rows
from udccal.io.atomic import write_atomically
from udccal.io.png import write_rgb8
from udccal.profiles.profile import Profile
from udccal.profiles.store import read_profile
from udccal.restoration.runtime import Restorer
from udccal.restoration.tone import to_rgb8
from udccal.simulation.truth import RigTruth

_FILE = "part.json"
_MINUTES, _GIB, _GAIN_DB = 20.0, 4.0, 10.0


@dataclass(frozen=True)
class Part:
    """The rows of one specimen, and the commit they were measured at."""

    draw: Draw
    commit: str
    rows: tuple[Row, ...]

    def write(self, folder: Path) -> None:
        """At once, so that a part is whole or not there."""
        fields = {"draw": str(self.draw), "commit": self.commit, "rows": [asdict(row) for row in self.rows]}
        write_atomically(folder / _FILE, (json.dumps(fields, indent=1) + "\n").encode())


def read_part(folder: Path) -> Part | None:
    """The part in a folder; None where it was not finished.

    Raises:
        ValueError: when its file is damaged.
    """
    file = folder / _FILE
    if not file.exists():
        return None
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
        rows = tuple(Row(**row) for row in found["rows"])
        return Part(Draw.named(found["draw"]), found["commit"], rows)
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"Expected {file} to be a finished part, found: {error!r}. Delete its folder.") from error


def main() -> None:
    """Measure the part; a calibration that fails is a row that misses its limit."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("draw", type=Draw.named)
    parser.add_argument("out", type=Path)
    parser.add_argument("--every", type=int, default=1, help="use each n-th scene only")
    options = parser.parse_args()
    draw, out, commit = options.draw, options.out, this_commit()
    try:
        run = calibrate(draw, out / "session", out / "profile")
    except RuntimeError as error:
        print(error, file=sys.stderr)
        rows = [at_least("profiles written", 0, 1, "")]
    else:
        rows = [at_least("profiles written", 1, 1, ""), *_cost_rows(run)]
        profile, truth = read_profile(out / "profile"), draw.truth
        rows += term_rows(profile, truth)
        print(table(rows), flush=True)
        if draw.rig in FULL:
            rows += _picture_rows(profile, truth, out, options.every)
    Part(draw, commit, tuple(rows)).write(out)


def _cost_rows(run: CalibrationRun) -> list[Row]:
    return [
        at_most("calibrate + fit, wall time", run.seconds / 60, _MINUTES, "min"),
        at_most("calibrate + fit, peak memory", run.peak_GiB, _GIB, "GiB"),
    ]


def _picture_rows(profile: Profile, truth: RigTruth, out: Path, every: int) -> list[Row]:
    """Scenes restored, at the light that is set and under other conditions."""
    data = Path(__file__).resolve().parents[3] / "shared" / "data"
    if not data.is_dir():
        print("The shared photographs (../shared/data) are absent: pictures are left out.", file=sys.stderr)
        return []
    captures = truth.description.captures
    blur = build_full_blur(truth, *BLUR_GRID, captures.psf_region_rows + 1, captures.psf_region_columns + 1)
    bench = PictureBench(truth, blur, Restorer.from_profile(profile))
    shots = bench.shots(shared_scenes(data, every))
    light = bench.matched_room_light(shots)
    print(f"room light {light:.3f}", flush=True)
    rows = []
    for conditions in CONDITIONS:
        scores = [bench.score(shot, light, conditions) for shot in shots]
        rows.append(_gain_row(conditions, scores))
        print(table(rows[-1:]), flush=True)
        if conditions is CONDITIONS[0]:
            _write_scenes(scores, out)
    return rows


def _gain_row(conditions: Conditions, scores: list[Score]) -> Row:
    """The limit holds at the light that is set. Under other conditions, restoration must not do harm."""
    before, after = (float(np.mean([getattr(s, name) for s in scores])) for name in ("before_dB", "after_dB"))
    name = f"picture, {conditions.name}: mean PSNR after - before ({before:.2f} to {after:.2f} dB)"
    return at_least(name, after - before, _GAIN_DB if conditions is CONDITIONS[0] else 0.0, "dB")


def _write_scenes(scores: list[Score], out: Path) -> None:
    """A line per scene, and the pictures of the one that gained least."""
    lines = [
        "| scene | before dB | after dB | before SSIM | after SSIM | restore s |",
        "| --- | ---: | ---: | ---: | ---: | ---: |",
    ]
    numbers = np.array([(s.before_dB, s.after_dB, s.before_ssim, s.after_ssim, s.restore_s) for s in scores])
    names = [*(s.name for s in scores), "**mean**"]
    for name, row in zip(names, [*numbers, numbers.mean(axis=0)], strict=True):
        lines.append(f"| {name} | {row[0]:.2f} | {row[1]:.2f} | {row[2]:.3f} | {row[3]:.3f} | {row[4]:.1f} |")
    text = "\n".join(lines) + "\n"
    print(text, flush=True)
    (out / "scenes.md").write_text(text, encoding="utf-8")
    worst = min(scores, key=lambda s: s.after_dB - s.before_dB)
    for kind in ("before", "after", "truth"):
        write_rgb8(out / f"worst_{kind}.png", to_rgb8(getattr(worst, kind)))


if __name__ == "__main__":
    main()
