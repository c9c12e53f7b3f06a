"""`make pareto`: every tier of restoration on the shared scenes: dB, SSIM and time, beside a camera's plain picture.

    python -m tests.benchmarks.pareto [--out DIR] [--rig NAME] [--profile PROFILE] [--seed N] [--every N] [--frames N]

The profile is that of the simulated rig's specimen ``--seed``. Writes DIR/pareto.json, DIR/pareto.csv, a line per tier
and scene, and the tables of docs/restoration.md: the tiers, and what each choice within one trades. Exits with 1 where
a number misses its limit.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import statistics
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from tests.benchmarks.full_blur import BLUR_GRID, build_full_blur
from tests.benchmarks.pictures import PictureBench, Score, Shot
from tests.benchmarks.readme_tables import put_table
from tests.benchmarks.rows import Row, at_least, table, write_json
from tests.benchmarks.scenes import shared_scenes
from udccal.profiles.store import load_profile
from udccal.restoration.plan import PlanOptions
from udccal.restoration.rectify import Interpolation
from udccal.restoration.runtime import Restorer
from udccal.restoration.tone import Tone, display_exposure
from udccal.rig import load_rig
from udccal.simulation.truth import draw_truth
from udccal.tiers import Tier

_PAGE = Path(__file__).resolve().parents[2] / "docs" / "restoration.md"
# No tier may be worse than the preview on any scene by more than this.
_LOSS_DB = 0.3


# Choices within a tier, each against the default of that tier.
_CHOICES: Final = (
    (Tier.preview, "interpolation: LINEAR", PlanOptions(interpolation=Interpolation.LINEAR)),
    (Tier.balanced, "interpolation: LINEAR", PlanOptions(interpolation=Interpolation.LINEAR)),
    (Tier.balanced, "interpolation: LANCZOS", PlanOptions(interpolation=Interpolation.LANCZOS)),
    (Tier.balanced, "tiles of 128 x 128", PlanOptions(tile_rows=128, tile_columns=128)),
    (Tier.balanced, "tiles of 512 x 512", PlanOptions(tile_rows=512, tile_columns=512)),
    (Tier.balanced, "kernels at 4 x 5 places", PlanOptions(grid_rows=4, grid_columns=5)),
    (Tier.balanced, "panel_block: 2", PlanOptions(panel_block=2)),
    (Tier.accurate, "network_views: 1", PlanOptions(network_views=1)),
    (Tier.accurate, "network_views: 2", PlanOptions(network_views=2)),
)


@dataclass(frozen=True)
class TierResult:
    """One tier on all scenes: seconds to prepare the profile, median times of a frame from raw to 8 bit."""

    tier: Tier
    ready_s: float
    frame_ms: float
    frame_cpu_ms: float
    scores: tuple[Score, ...]

    def mean(self, name: str) -> float:
        """Mean of a score over the scenes."""
        return float(np.mean([getattr(score, name) for score in self.scores]))


def main() -> int:
    """Run the benchmark; the exit status is 0 when every number keeps its limit."""
    options = _options()
    options.out.mkdir(parents=True, exist_ok=True)
    data = Path(__file__).resolve().parents[3] / "shared" / "data"
    if not data.is_dir():
        print("The shared photographs (../shared/data) are absent: there is nothing to restore.", file=sys.stderr)
        return 1
    truth, profile = draw_truth(load_rig(options.rig), options.seed), load_profile(options.profile or options.rig)
    captures = truth.description.captures
    blur = build_full_blur(truth, *BLUR_GRID, captures.psf_region_rows + 1, captures.psf_region_columns + 1)
    bench = PictureBench(truth, blur, Restorer.from_profile(profile, Tier.preview))
    shots = bench.shots(shared_scenes(data, options.every))
    light = bench.matched_room_light(shots)

    def measured(tier: Tier, choice: PlanOptions) -> TierResult:
        start = time.perf_counter()
        restorer = Restorer.from_profile(profile, tier, choice)
        ready_s = time.perf_counter() - start
        return _measured(tier, ready_s, PictureBench(truth, blur, restorer), restorer, shots, light, options)

    results = [measured(tier, PlanOptions()) for tier in Tier]
    print(_summary(results), flush=True)
    choices = [(name, measured(tier, choice)) for tier, name, choice in _CHOICES]
    put_table(_PAGE, f"choices {options.rig}", _traded(results, choices))
    _write_csv(results, options.out / "pareto.csv")
    rows = judged(results)
    write_json(rows, options.out / "pareto.json")
    print(table(rows))
    put_table(_PAGE, f"pareto {options.rig}", _summary(results))
    return 0 if all(row.ok for row in rows) else 1


def _measured(
    tier: Tier,
    ready_s: float,
    bench: PictureBench,
    restorer: Restorer,
    shots: list[Shot],
    light: float,
    options: argparse.Namespace,
) -> TierResult:
    scores = tuple(bench.score(shot, light) for shot in shots)
    wall, cpu = [], []
    for shot in shots[:: max(len(shots) // options.frames, 1)]:
        frame, exposure_s = bench.frame(shot, light), bench.exposure_s(shot, light)
        tone = Tone(display_exposure(restorer.restore(frame, exposure_s)))
        start, busy = time.perf_counter(), time.process_time()
        restorer.display(frame, exposure_s, tone, bench.pictures[shot.picture])
        wall.append(time.perf_counter() - start)
        cpu.append(time.process_time() - busy)
    return TierResult(tier, ready_s, 1e3 * statistics.median(wall), 1e3 * statistics.median(cpu), scores)


def judged(results: list[TierResult]) -> list[Row]:
    """Each tier is better on average than the one before, and on no scene worse than the preview."""
    rows = []
    for quicker, slower in itertools.pairwise(results):
        gain = slower.mean("after_dB") - quicker.mean("after_dB")
        rows.append(at_least(f"{slower.tier}: mean dB - {quicker.tier}'s", gain, 0.0, "dB"))
    for result in results[1:]:
        worst = min(a.after_dB - b.after_dB for a, b in zip(result.scores, results[0].scores, strict=True))
        rows.append(at_least(f"{result.tier}: worst scene's dB - {results[0].tier}'s", worst, -_LOSS_DB, "dB"))
    return rows


def _summary(results: list[TierResult]) -> str:
    lines = [
        "| tier | before dB | after dB | SSIM | frame ms | frame CPU ms | ready s |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for r in results:
        picture = f"{r.mean('before_dB'):.2f} | {r.mean('after_dB'):.2f} | {r.mean('after_ssim'):.3f}"
        lines.append(f"| {r.tier} | {picture} | {r.frame_ms:.0f} | {r.frame_cpu_ms:.0f} | {r.ready_s:.1f} |")
    return "\n".join(lines)


def _traded(defaults: list[TierResult], choices: list[tuple[str, TierResult]]) -> str:
    lines = ["| tier | choice | dB − the default's | worst scene | CPU time / the default's |"]
    lines.append("| --- | --- | ---: | ---: | ---: |")
    for name, found in choices:
        default = next(one for one in defaults if one.tier is found.tier)
        gains = [a.after_dB - b.after_dB for a, b in zip(found.scores, default.scores, strict=True)]
        time_ratio = found.frame_cpu_ms / default.frame_cpu_ms
        lines.append(f"| {found.tier} | {name} | {np.mean(gains):+.2f} | {min(gains):+.2f} | {time_ratio:.2f} |")
    return "\n".join(lines)


def _write_csv(results: list[TierResult], path: Path) -> None:
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(["tier", "scene", "before_dB", "after_dB", "before_ssim", "after_ssim", "restore_s"])
        for result in results:
            for s in result.scores:
                numbers = (s.before_dB, s.after_dB, s.before_ssim, s.after_ssim, s.restore_s)
                writer.writerow([result.tier, s.name, *(f"{number:.4g}" for number in numbers)])


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("pareto"), help="folder for results")
    parser.add_argument("--rig", default="lg55-reduced", help="a rig's name")
    parser.add_argument("--profile", help="its profile; by default the one that ships with the rig")
    parser.add_argument("--seed", type=int, default=0, help="specimen of the simulated rig")
    parser.add_argument("--every", type=int, default=1, help="use each n-th scene only")
    parser.add_argument("--frames", type=int, default=20, help="frames that are timed")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
