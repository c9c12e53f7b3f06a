"""`make efficiency`: is every fit at its Cramér–Rao bound, and are its sigmas true? Writes efficiency.json."""

from __future__ import annotations

import argparse
import importlib
import sys
import time
from pathlib import Path

from tests.benchmarks.efficiency.trials import Figure, figure, table, write_json
from tests.benchmarks.readme_tables import between

# Each module has ``trials(share) -> list[Trials]``; with share 1 it makes as many realisations as its figures need.
_PAGE = Path(__file__).resolve().parents[3] / "docs" / "numerics.md"
MODULES = ("noise", "hdr", "geometry", "wire", "psf", "psf_stamps", "backscatter")


def main() -> None:
    """Run the chosen terms; non-zero exit where a figure is missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("terms", nargs="*", default=list(MODULES), choices=[[], *MODULES], metavar="term")
    parser.add_argument("--out", type=Path, default=Path("efficiency"), help="folder for efficiency.json and .md")
    parser.add_argument("--share", type=float, default=1.0, help="of the realisations; for a quick look")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    figures: list[Figure] = []
    for term in options.terms or MODULES:
        start = time.perf_counter()
        module = importlib.import_module(f"tests.benchmarks.efficiency.{term}")
        found = [figure(trials) for trials in module.trials(options.share)]
        print(f"{term}: {time.perf_counter() - start:.0f} s\n{table(found)}\n", flush=True)
        figures += found
        # Term by term: nothing is lost where a later one is stopped.
        write_json(figures, options.out / "efficiency.json")
        (options.out / "efficiency.md").write_text(table(figures) + "\n", encoding="utf-8")
    if set(options.terms or MODULES) == set(MODULES) and options.share == 1.0:
        _PAGE.write_text(between(_PAGE.read_text(encoding="utf-8"), "efficiency", table(figures)), encoding="utf-8")
    sys.exit(0 if all(f.ok for f in figures) else 1)


if __name__ == "__main__":
    main()
