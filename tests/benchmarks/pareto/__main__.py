"""`make pareto`: every tier of restoration on many scenes: dB, SSIM, FLIP, time, memory, and what is planned.

    python -m tests.benchmarks.pareto [--out DIR] [--rig NAME] [--profile PROFILE] [--seed N] [--every N] [--device gpu]
                                      [--peers DIR] [--environments DIR]

The profile is that of the simulated rig's specimen ``--seed``. Writes DIR/pareto.csv, a line per run; DIR/pareto.json,
the numbers that have a limit; DIR/pareto.svg; DIR/TIER.png, pictures to look at; and DIR/pareto.md, all tables. A run
of all scenes also puts the tables into docs/restoration.md, docs/tiers.md and README.md where these have markers for
the rig. Exits with 1 where a number misses its limit. Nothing else should run meanwhile. With ``--device gpu``, the
tiers on a GPU are measured instead (``tests.benchmarks.device``). Others' programs run in environments that ``make
peers`` makes; rows of those that are absent say so.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

from tests.benchmarks import device
from tests.benchmarks.pareto.choices import traded, traded_table
from tests.benchmarks.pareto.drawing import draw
from tests.benchmarks.pareto.groups import Group
from tests.benchmarks.pareto.measuring import PeerFolders, kept_of, measured, seen_by
from tests.benchmarks.pareto.runs import write_csv
from tests.benchmarks.pareto.tables import Measured, compact_table, full_table
from tests.benchmarks.readme_tables import has_table, put_table
from tests.benchmarks.rows import table, write_json
from udccal.profiles.store import load_profile
from udccal.rig import load_rig
from udccal.simulation.truth import draw_truth

_ROOT = Path(__file__).resolve().parents[3]
_PAGE, _TIERS, _README = _ROOT / "docs" / "restoration.md", _ROOT / "docs" / "tiers.md", _ROOT / "README.md"
# Every n-th of the nineteen shows what a choice trades.
_CHOICES_EVERY = 3


def main() -> int:
    """Run the benchmark; the exit status is 0 when every number keeps its limit."""
    options, start = _options(), time.monotonic()
    if options.device != "cpu":
        return device.measure(options.device, options.rig, options.profile or options.rig, every=options.every)
    options.out.mkdir(parents=True, exist_ok=True)
    data = _ROOT.parent / "shared" / "data"
    if not data.is_dir():
        print("The shared photographs (../shared/data) are absent: there is nothing to restore.", file=sys.stderr)
        return 1

    def say(what: str) -> None:
        print(f"{(time.monotonic() - start) / 60:5.1f} min: {what}", flush=True)

    peers = PeerFolders(options.peers, options.environments)
    name = options.profile or options.rig
    profile = load_profile(name)
    seen = seen_by(draw_truth(load_rig(options.rig), options.seed), profile, data, options.every)
    say(f"{len(seen.sights)} frames are taken")
    with tempfile.TemporaryDirectory() as folder:
        found = measured(name, profile, seen, options.out, Path(folder), peers, say)
        some = [sight for sight in seen.usual if sight.case.group is Group.nineteen][::_CHOICES_EVERY]
        choices = traded_table(traded(name, some, kept_of(Path(folder))))
        say("choices are traded")
    _write(found, choices, options)
    return 0 if all(row.ok for row in found.rows) else 1


def _write(found: Measured, choices: str, options: argparse.Namespace) -> None:
    """Everything but the sheets; part of the scenes leaves the pages as they are."""
    out, rig = options.out, options.rig
    write_csv(found.runs, out / "pareto.csv")
    write_json(list(found.rows), out / "pareto.json")
    draw(found.runs, found.clear, f"Tiers of restoration, {rig}", out / "pareto.svg")
    contents = (
        (_PAGE, "pareto", full_table(found)),
        (_PAGE, "choices", choices),
        (_TIERS, "pareto", compact_table(found)),
        (_README, "pareto", compact_table(found)),
    )
    (out / "pareto.md").write_text("\n\n".join(content for *_, content in contents) + "\n", encoding="utf-8")
    print(table(list(found.rows)))
    if options.every != 1:
        return
    for page, what, content in contents:
        if has_table(page, f"{what} {rig}"):
            put_table(page, f"{what} {rig}", content)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("pareto"), help="folder for results")
    parser.add_argument("--rig", default="lg55-reduced", help="a rig's name")
    parser.add_argument("--profile", help="its profile; by default the one that ships with the rig")
    parser.add_argument("--seed", type=int, default=0, help="specimen of the simulated rig")
    parser.add_argument("--every", type=int, default=1, help="use each n-th scene only")
    parser.add_argument("--peers", type=Path, default=_ROOT.parent / "shared" / "peers", help="folder of works.py")
    parser.add_argument("--environments", type=Path, default=Path(tempfile.gettempdir()) / "peers")
    parser.add_argument(
        "--device", choices=("cpu", "gpu"), default="cpu", help="gpu: measure the tiers on a GPU instead"
    )
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
