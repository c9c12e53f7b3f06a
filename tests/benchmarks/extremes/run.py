"""`make extremes`: every fit at the ends of its range. Puts each term's table into docs/numerics.md."""

from __future__ import annotations

import argparse
import importlib
import sys
import time
from pathlib import Path

from tests.benchmarks.extremes.case import Case, Outcome, table
from tests.benchmarks.readme_tables import between

# Each module has ``CASES``.
MODULES = ("noise", "hdr", "geometry", "wire", "psf", "backscatter")
_PAGE = Path(__file__).resolve().parents[3] / "docs" / "numerics.md"


def main() -> None:
    """Run the chosen terms; non-zero exit where one fails."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("terms", nargs="*", default=list(MODULES), choices=[[], *MODULES], metavar="term")
    terms = parser.parse_args().terms or list(MODULES)
    fine = True
    for term in terms:
        rows: list[tuple[Case, Outcome, float]] = []
        for case in importlib.import_module(f"tests.benchmarks.extremes.{term}").CASES:
            start = time.perf_counter()
            found = case.run()
            rows.append((case, found, time.perf_counter() - start))
            print(f"{term}: {case.name}: {found.status.name} {'ok' if found.ok else 'MISSED'}", flush=True)
        text = _PAGE.read_text(encoding="utf-8")
        _PAGE.write_text(between(text, f"extremes {term}", table(rows)), encoding="utf-8")
        fine &= all(found.ok for _, found, _ in rows)
    sys.exit(0 if fine else 1)


if __name__ == "__main__":
    main()
