"""`make accuracy`: calibrate two full-size simulated rigs, compare with their truth, restore the shared scenes.

    python -m tests.benchmarks.accuracy [--out DIR] [--rig NAME ...] [--seed N] [--every N] [--reuse]

Prints the table, writes DIR/accuracy.json, DIR/scenes.md and the worst scene's pictures; exits with 1 where a number
misses its limit.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from tests.benchmarks.calibration_run import CalibrationRun, calibrate
from tests.benchmarks.pictures import PictureBench, Score
from tests.benchmarks.rows import Row, at_least, at_most, table, write_json
from tests.benchmarks.scenes import shared_scenes
from tests.benchmarks.terms import term_rows
from udccal.io.png import write_rgb8
from udccal.profiles.store import read_profile
from udccal.restoration.runtime import Restorer
from udccal.restoration.tone import to_rgb8
from udccal.rig import load_rig
from udccal.simulation.blur import build_blur
from udccal.simulation.truth import draw_truth

RIGS = ("lg55-aca2040", "mk31-imx1600")
_MINUTES, _GIB, _GAIN_DB = 20.0, 4.0, 10.0
_BLUR_GRID = (9, 13)


def main() -> int:
    """Run the benchmark; the exit status is 0 when every number keeps its limit."""
    options = _options()
    out: Path = options.out
    out.mkdir(parents=True, exist_ok=True)
    rows: list[Row] = []
    rigs = options.rig or RIGS
    # All before the first picture: the system counts what a parent holds to the peak memory of its child.
    costs = {rig: _calibrated(rig, options.seed, out / rig, options.reuse) for rig in rigs}
    for rig in rigs:
        found = costs[rig] + _measure(rig, options.seed, out / rig, options.every)
        rows += [Row(f"{rig}: {r.name}", r.value, r.limit, r.unit, r.ok) for r in found]
        write_json(rows, out / "accuracy.json")
    print(table(rows))
    return 0 if all(row.ok for row in rows) else 1


def _calibrated(rig: str, seed: int, out: Path, reuse: bool) -> list[Row]:
    """Calibrate, unless the profile is there and to be used again; what that cost."""
    out.mkdir(parents=True, exist_ok=True)
    if reuse and (out / "profile").exists():
        return []
    return _cost_rows(calibrate(rig, out / "session", out / "profile", seed))


def _measure(rig: str, seed: int, out: Path, every: int) -> list[Row]:
    profile, truth = read_profile(out / "profile"), draw_truth(load_rig(rig), seed)
    rows = term_rows(profile, truth)
    print(table(rows), flush=True)
    data = Path(__file__).resolve().parents[3] / "shared" / "data"
    if not data.is_dir():
        print("The shared photographs (../shared/data) are absent: pictures are left out.", file=sys.stderr)
        return rows
    captures, camera = truth.description.captures, truth.description.camera
    blur = build_blur(truth, *_BLUR_GRID, captures.psf_region_rows + 1, captures.psf_region_columns + 1)
    bench = PictureBench(truth, blur, Restorer.from_profile(profile))
    shots = bench.shots(shared_scenes(data, every))
    light = bench.matched_room_light(shots)
    print(f"{rig}: {camera.columns} x {camera.rows}, room light {light:.3f}", flush=True)
    scores = [bench.score(shot, light) for shot in shots]
    _write_scenes(scores, out)
    before, after = (float(np.mean([getattr(s, name) for s in scores])) for name in ("before_dB", "after_dB"))
    name = f"picture: mean PSNR after - before ({before:.2f} to {after:.2f} dB)"
    return [*rows, at_least(name, after - before, _GAIN_DB, "dB")]


def _cost_rows(run: CalibrationRun) -> list[Row]:
    return [
        at_most("calibrate + fit, wall time", run.seconds / 60, _MINUTES, "min"),
        at_most("calibrate + fit, peak memory", run.peak_GiB, _GIB, "GiB"),
    ]


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


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("accuracy"), help="folder for results")
    parser.add_argument("--rig", action="append", help="a rig's name; may be given again")
    parser.add_argument("--seed", type=int, default=0, help="seed of the simulated rig")
    parser.add_argument("--every", type=int, default=1, help="use each n-th scene only")
    parser.add_argument("--reuse", action="store_true", help="use the profiles already in the folder")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
