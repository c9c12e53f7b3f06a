"""`make rigs`: rigs of which every number, opening and noise is drawn, written by a program that is not udccal's.

    python -m tests.benchmarks.drawn_rigs [--out DIR] [--rigs N] [--first SEED] [--again SEED] [--page]

A quantity is missed where it is beyond its limit and the profile says nothing of it. Each rig is measured once: a run
that was stopped goes on where it was. Seeds from 1000 on are for development. Prints and writes the table, writes
DIR/drawn.json; exits with 1 where a quantity is missed.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from tests.benchmarks.drawn_rigs.judge import Judged
from tests.benchmarks.drawn_rigs.one import Finished, read_finished
from tests.benchmarks.readme_tables import put_table
from tests.benchmarks.rows import Row, write_json

_PAGE = Path(__file__).resolve().parents[3] / "docs" / "accuracy.md"
_JUDGED = 12


def main() -> int:
    """Run what is missing; the exit status is 0 when nothing is silently wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("drawn"), help="folder for results")
    parser.add_argument("--rigs", type=int, default=_JUDGED, help="how many rigs")
    parser.add_argument("--first", type=int, default=0, help="seed of the first")
    parser.add_argument("--again", type=int, metavar="SEED", help="one rig again, with all its numbers")
    parser.add_argument("--page", action="store_true", help=f"put a table of fewer than {_JUDGED} rigs into the page")
    options = parser.parse_args()
    if options.again is not None:
        found = _measured(options.again, options.out / f"again-{options.again}")
        print(numbers(found))
        return 0 if all(one.ok for one in found.quantities) else 1
    finished = []
    for seed in range(options.first, options.first + options.rigs):
        folder = options.out / f"rig-{seed}"
        finished.append(read_finished(folder) or _measured(seed, folder))
        print(numbers(finished[-1]), flush=True)
    rows = [row for one in finished for row in rows_of(one)]
    write_json(rows, options.out / "drawn.json")
    print(table(finished))
    if options.rigs >= _JUDGED or options.page:
        put_table(_PAGE, "drawn", table(finished), [one.commit for one in finished])
    return 0 if all(row.ok for row in rows) else 1


def _measured(seed: int, folder: Path) -> Finished:
    """In a process of its own."""
    subprocess.run([sys.executable, "-m", "tests.benchmarks.drawn_rigs.one", str(seed), str(folder)], check=True)
    found = read_finished(folder)
    if found is None:
        raise RuntimeError(f"Expected a judgement in {folder}, found none. Run the rig again.")
    return found


def rows_of(rig: Finished) -> list[Row]:
    """The rows of a rig for ``drawn.json``; one that is beyond its limit and told is ok, and its name says so."""
    told = {one.name: "" if one.within or not one.told else ", told" for one in rig.quantities}
    return [
        Row(f"rig {rig.seed}: {one.name}{told[one.name]}", one.value, one.limit, one.unit, one.ok)
        for one in rig.quantities
    ]


def numbers(rig: Finished) -> str:
    """Every number of one rig, with what the profile says of it."""
    lines = [f"rig {rig.seed} ({rig.what}), {rig.cpu_s:.0f} CPU-s"]
    for one in rig.quantities:
        verdict = "ok" if one.within else "told" if one.told else "SILENT"
        lines.append(
            f"  {verdict:6} {one.name}: {one.value:.3g} (limit {one.limit:g}) {one.unit}, "
            f"stated {one.stated:.2g} {one.said}"
        )
    return "\n".join(lines)


def table(rigs: Iterable[Finished]) -> str:
    """Every quantity over the rigs, as Markdown."""
    grouped: dict[str, list[Judged]] = {}
    for rig in rigs:
        for one in rig.quantities:
            grouped.setdefault(one.name, []).append(one)
    lines = [
        "| quantity | median | worst | limit | unit | within | said to be off | silent | |",
        "| --- | ---: | ---: | ---: | --- | ---: | ---: | ---: | --- |",
    ]
    for name, ones in grouped.items():
        values = np.array([one.value for one in ones])
        within, silent = sum(one.within for one in ones), sum(not one.ok for one in ones)
        size = f"{np.median(values):.3g} | {values.max():.3g} | {ones[0].limit:g} | {ones[0].unit}"
        counts = f"{within} | {len(ones) - within - silent} | {silent} | {'**missed**' if silent else 'ok'}"
        lines.append(f"| {name} | {size} | {counts} |")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
