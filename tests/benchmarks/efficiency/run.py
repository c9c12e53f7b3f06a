"""`make efficiency`: is every fit at its Cramér–Rao bound, and are its sigmas true? Writes efficiency.json."""

from __future__ import annotations

import argparse
import importlib
import json
import sys
import time
from pathlib import Path

from tests.benchmarks.efficiency.trials import Figure, figure, table, write_json
from tests.benchmarks.readme_tables import put_table

# Each module has ``trials(share) -> list[Trials]``; with share 1 it makes as many realisations as its figures need.
_PAGE = Path(__file__).resolve().parents[3] / "docs" / "numerics.md"
_FILE = "efficiency.json"
MODULES = ("noise", "hdr", "geometry", "wire", "psf", "psf_stamps", "backscatter")


def main() -> None:
    """Run the chosen terms; non-zero exit where a figure is missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("terms", nargs="*", default=[], choices=[[], *MODULES], metavar="term")
    parser.add_argument("--out", type=Path, default=Path("efficiency"), help="folder for efficiency.json")
    parser.add_argument("--share", type=float, default=1.0, help="of the realisations; for a quick look")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    found: list[Figure] = []
    for term in options.terms or MODULES:
        start = time.perf_counter()
        module = importlib.import_module(f"tests.benchmarks.efficiency.{term}")
        own = [figure(trials) for trials in module.trials(options.share)]
        print(f"{term}: {time.perf_counter() - start:.0f} s\n{table(own)}\n", flush=True)
        found += own
        # Term by term: nothing is lost where a later one is stopped. Figures of terms that are not run stay.
        write_json([*_others(options.out / _FILE, term), *own], options.out / _FILE)
        if options.share == 1.0:
            put_table(_PAGE, f"efficiency {term}", table(own))
    sys.exit(0 if all(f.ok for f in found) else 1)


def _others(path: Path, term: str) -> list[Figure]:
    """Figures of other terms that an earlier run has left."""
    if not path.exists():
        return []
    figures = [Figure(**line) for line in json.loads(path.read_text(encoding="utf-8"))]
    return [f for f in figures if not f.name.startswith(f"{term}/")]


if __name__ == "__main__":
    main()
