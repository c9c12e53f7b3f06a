"""`make robust`: data sets that nobody tuned for. Writes robust.json and the table of docs/numerics.md."""

from __future__ import annotations

import argparse
import importlib
import multiprocessing
import sys
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np

from tests.benchmarks.commit import this_commit
from tests.benchmarks.readme_tables import between
from tests.benchmarks.robust.family import MOST_OVER_BOUND, WORST_Z, Family, Kind, Verdict, judge
from tests.benchmarks.rows import Row, at_most, table, write_json

# Each module has ``FAMILY``.
MODULES = ("noise", "hdr", "geometry", "wire", "backscatter", "stamps", "wrong")
_PAGE = Path(__file__).resolve().parents[3] / "docs" / "numerics.md"
_LISTED = 5

# After some hundred and thirty fits of different sizes in one process, XLA crashed.
_IN_A_PROCESS = 50


def main() -> None:
    """Run the chosen families; non-zero exit where a row is missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("robust"), help="folder for robust.json")
    parser.add_argument("--family", choices=MODULES, action="append", help="only this one; may be repeated")
    parser.add_argument("--sets", type=int, default=200, help="data sets of each family")
    parser.add_argument("--seed", type=int, default=0, help="the first seed")
    parser.add_argument("--workers", type=int, default=2, help="data sets at a time")
    parser.add_argument("--only-worst", action="store_true", help="print only what was missed")
    parser.add_argument("--page", action="store_true", help="put the tables of fewer than 200 sets into the page, too")
    parser.add_argument("--again", metavar="FAMILY/SEED", help="one data set again, with all its numbers")
    options = parser.parse_args()
    if options.again:
        name, seed = options.again.split("/")
        sys.exit(0 if again(name, int(seed)) else 1)
    seeds, rows = range(options.seed, options.seed + options.sets), list[Row]()
    options.out.mkdir(parents=True, exist_ok=True)
    for name in options.family or MODULES:
        parts = [seeds[first : first + _IN_A_PROCESS] for first in range(0, len(seeds), _IN_A_PROCESS)]
        # In processes of their own: compilations do not pile up.
        spawn = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(options.workers, spawn, max_tasks_per_child=1) as pool:
            judged = pool.map(partial(run, name, only_worst=options.only_worst), parts)
            found = rows_of(family(name), [verdict for part in judged for verdict in part])
        print(f"{table(found)}\n", flush=True)
        rows += found
        write_json(rows, options.out / "robust.json")
        if options.sets >= 200 or options.page:
            made = f"Commit {this_commit()}, seeds {seeds[0]} to {seeds[-1]}.\n\n{table(found)}"
            _PAGE.write_text(between(_PAGE.read_text(encoding="utf-8"), f"robust {name}", made), encoding="utf-8")
    sys.exit(0 if all(row.ok for row in rows) else 1)


def family(name: str) -> Family:
    """The family of this name."""
    found: Family = importlib.import_module(f"tests.benchmarks.robust.{name}").FAMILY
    return found


def run(name: str, seeds: Iterable[int], only_worst: bool) -> list[Verdict]:
    """The verdicts of a family."""
    drawn, verdicts = family(name), list[Verdict]()
    for seed in seeds:
        found = judge(drawn.draw(seed), seed)
        verdicts.append(found)
        if not (only_worst and found.ok):
            print(f"{name}/{seed}: {found.kind.name} {found.size:.1f} {found.why} [{found.what}]", flush=True)
    return verdicts


def again(name: str, seed: int) -> bool:
    """One data set again; prints every number, and says whether nothing wrong was silent."""
    found = judge(family(name).draw(seed), seed)
    print(f"{name}/{seed}: {found.kind.name} {found.size:.1f} {found.why} [{found.what}], {found.cpu_s:.1f} CPU-s")
    for one in found.numbers:
        print(f"  {one.name}: error {one.error:.4g}, sigma {one.sigma:.4g}, {one.z:.1f} sigma, bound {one.bound:.4g}")
    return found.ok


def rows_of(drawn: Family, verdicts: list[Verdict]) -> list[Row]:
    """The rows of a family: what was silent, raw or not finite, the worst seeds, and what it cost."""
    name, count = drawn.name, len(verdicts)
    rows = [
        at_most(f"{name}: {kind.value}", sum(one.kind is kind for one in verdicts), 0, f"of {count}")
        for kind in (Kind.SILENT, Kind.RAW_ERROR, Kind.NOT_FINITE)
    ]
    if sound := [one for one in verdicts if one.sound]:
        refused = sum(one.kind is Kind.REFUSED for one in sound)
        most = max(1, int(drawn.most_refused * len(sound)))
        rows.append(at_most(f"{name}: sound data refused", refused, most, f"of {len(sound)}"))
    rows += _over_bound(name, verdicts)
    if drawn.most_cpu_s < np.inf:
        slowest = max(verdicts, key=lambda one: one.cpu_s / max(one.work, 1.0))
        limit_s = drawn.most_cpu_s * max(slowest.work, 1.0)
        rows.append(at_most(f"{name}/{slowest.seed}: slowest, {slowest.what[:30]}", slowest.cpu_s, limit_s, "CPU-s"))
    if drawn.most_MiB < np.inf and (usual := [one for one in verdicts if one.work <= 1.0]):
        largest = max(usual, key=lambda one: one.peak_MiB)
        rows.append(at_most(f"{name}/{largest.seed}: peak of memory", largest.peak_MiB, drawn.most_MiB, "MiB"))
    worst = sorted(verdicts, key=lambda one: one.size, reverse=True)[:_LISTED]
    # JSON has no infinity: an error without a number of sigma is a thousand.
    rows += [at_most(f"{name}/{one.seed}: {one.why[:60]}", min(one.size, 1e3), WORST_Z, "sigma") for one in worst]
    return rows


def _over_bound(name: str, verdicts: list[Verdict]) -> list[Row]:
    """The quantity whose median sigma is largest in units of its bound."""
    numbers = [one for verdict in verdicts for one in verdict.numbers if one.bound > 0]
    medians = {
        quantity: float(np.median([one.sigma / one.bound for one in numbers if one.name == quantity]))
        for quantity in {one.name for one in numbers}
    }
    if not medians:
        return []
    worst = max(medians, key=lambda quantity: medians[quantity])
    return [at_most(f"{name}: median sigma of {worst}, over its bound", medians[worst], MOST_OVER_BOUND, "1")]


if __name__ == "__main__":
    main()
