"""`make extremes`: every fit at the ends of its range. Puts each term's table into docs/numerics.md."""

from __future__ import annotations

import argparse
import importlib
import sys
import time
from pathlib import Path

from tests.benchmarks.extremes import basin as basins
from tests.benchmarks.extremes.case import Case, Outcome, table
from tests.benchmarks.readme_tables import put_table

# Each module has ``CASES``.
MODULES = ("noise", "hdr", "geometry", "wire", "psf", "backscatter")
_BASIN = "basin"
_PAGE = Path(__file__).resolve().parents[3] / "docs" / "numerics.md"


def main() -> None:
    """Run the chosen terms; non-zero exit where one fails."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("terms", nargs="*", default=[], choices=[[], *MODULES, _BASIN], metavar="term")
    terms = parser.parse_args().terms or [*MODULES, _BASIN]
    fine = [_basins() if term == _BASIN else _extremes(term) for term in terms]
    sys.exit(0 if all(fine) else 1)


def _extremes(term: str) -> bool:
    """All cases of a term into the page; whether none was missed."""
    rows: list[tuple[Case, Outcome, float]] = []
    for case in importlib.import_module(f"tests.benchmarks.extremes.{term}").CASES:
        start = time.perf_counter()
        found = case.run()
        rows.append((case, found, time.perf_counter() - start))
        print(f"{term}: {case.name}: {found.status.name} {'ok' if found.ok else 'MISSED'}", flush=True)
    put_table(_PAGE, f"extremes {term}", table(rows))
    return all(found.ok for _, found, _ in rows)


def _basins() -> bool:
    rows = []
    for start in basins.STARTS:
        rows.append(basins.basin(start))
        print(f"{start.term}: {start.what}: {rows[-1].least:g} to {rows[-1].most:g}", flush=True)
    put_table(_PAGE, _BASIN, basins.table(rows))
    return all(row.ok for row in rows)


if __name__ == "__main__":
    main()
