"""`make accuracy`: calibrate simulated rigs, compare with their truth, restore the shared scenes.

    python -m tests.benchmarks.accuracy [--out DIR] [--rig NAME ...] [--seeds N] [--every N] [--keep]

One specimen of each full-size rig and N of each reduced one, all drawn independently. Each is a part of its own,
DIR/RIG-NUMBER, and is measured once per commit: a run that was stopped goes on where it was, and a run of some rigs
(``--rig``) adds to the parts that are there. Prints the table of all of them, writes DIR/accuracy.json and
DIR/accuracy.md; exits with 1 where a number misses its limit.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tests.benchmarks.accuracy_part import Part, read_part
from tests.benchmarks.commit import is_clean, stamped, this_commit
from tests.benchmarks.draws import FULL, REDUCED, Draw, draws
from tests.benchmarks.rows import AT_LEAST, Row, write_json

_MARK = "commit.txt"


@dataclass(frozen=True)
class Summary:
    """One quantity of a rig: median and worst over its specimens."""

    rig: str
    specimens: int
    median: Row
    worst: Row


def main() -> int:
    """Measure what is missing and merge; the exit status is 0 when every number keeps its limit."""
    options = _options()
    out: Path = options.out
    for draw in draws(options.seeds, tuple(options.rig or FULL + REDUCED)):
        folder = out / str(draw)
        if _prepared(folder, options.keep):
            print(f"{draw}: measured at {this_commit()}", flush=True)
            command = [sys.executable, "-m", "tests.benchmarks.accuracy_part", str(draw), str(folder)]
            subprocess.run([*command, "--every", str(options.every)], check=True)
    parts = finished(out)
    found = summaries(parts)
    rows = [row for one in found for row in (one.median, one.worst)]
    write_json(rows, out / "accuracy.json")
    text = stamped(table(found), [part.commit for part in parts])
    (out / "accuracy.md").write_text(text + "\n", encoding="utf-8")
    print(text)
    return 0 if all(row.ok for row in rows) else 1


def _prepared(folder: Path, keep: bool) -> bool:
    """Whether a part is to be measured; what another commit has left of it is removed first."""
    mark, commit = folder / _MARK, this_commit()
    begun = mark.read_text(encoding="utf-8").strip() if mark.exists() else None
    if begun is not None and not keep and (begun != commit or not is_clean(commit)):
        shutil.rmtree(folder)
    folder.mkdir(parents=True, exist_ok=True)
    if not mark.exists():
        mark.write_text(commit + "\n", encoding="utf-8")
    return read_part(folder) is None


def finished(out: Path) -> list[Part]:
    """All finished parts of a folder, in the order of the table."""
    order = [str(draw) for draw in draws(1000)]
    folders = sorted((f for f in out.iterdir() if f.name in order), key=lambda f: order.index(f.name))
    return [part for part in map(read_part, folders) if part is not None]


def summaries(parts: Iterable[Part]) -> list[Summary]:
    """Every quantity of every rig over its specimens, in the order of the rows."""
    grouped: dict[tuple[str, str], list[tuple[Draw, Row]]] = {}
    for part in parts:
        for row in part.rows:
            grouped.setdefault((part.draw.rig, row.name), []).append((part.draw, row))
    return [_summary(rig, [row for _, row in rows]) for (rig, _), rows in grouped.items()]


def _summary(rig: str, rows: list[Row]) -> Summary:
    first, values = rows[0], np.array([row.value for row in rows])
    lower = first.name.endswith(AT_LEAST)
    # A number that is not one stays so: it must not pass for the best.
    middle, worst = float(np.median(values)), float(values.min() if lower else values.max())

    def row(what: str, value: float) -> Row:
        ok = bool(value >= first.limit if lower else value <= first.limit)
        return Row(f"{rig}: {first.name}, {what} of {len(rows)}", value, first.limit, first.unit, ok)

    return Summary(rig, len(rows), row("median", middle), row("worst", worst))


def table(found: list[Summary]) -> str:
    """As Markdown."""
    head = [
        "| quantity | median | worst | limit | unit | specimens | |",
        "| --- | ---: | ---: | ---: | --- | ---: | --- |",
    ]
    body = []
    for one in found:
        name = one.worst.name.removesuffix(f", worst of {one.specimens}")
        said = "ok" if one.worst.ok and one.median.ok else "**missed**"
        numbers = f"{one.median.value:.3g} | {one.worst.value:.3g} | {one.worst.limit:g}"
        body.append(f"| {name} | {numbers} | {one.worst.unit} | {one.specimens} | {said} |")
    return "\n".join(head + body)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("accuracy"), help="folder for results")
    parser.add_argument("--rig", action="append", choices=FULL + REDUCED, help="this rig; may be given again")
    parser.add_argument("--seeds", type=int, default=8, help="specimens of each reduced rig")
    parser.add_argument("--every", type=int, default=1, help="use each n-th scene only")
    parser.add_argument("--keep", action="store_true", help="keep parts of other commits, and of a changed tree")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
