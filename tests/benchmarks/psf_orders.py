"""Which residual the psf fit chooses in addition to diffraction on rigs where it is known.

    python -m tests.benchmarks.psf_orders [--runs N]

Every kind of rig is drawn N times; prints how often which degree and width were chosen, and exits with 1 where the
right ones were in fewer than 95 of 100.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter

from tests.scenes.psf_orders import ENOUGH, KINDS, chosen, world


def main() -> int:
    """Run all kinds; the exit status is 0 where the right degree is chosen often enough."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=100, help="of every kind of rig")
    runs: int = parser.parse_args().runs
    known, good = world(), True
    print("| residual's degree (-1: none), width | chosen | of runs |\n| ---: | ---: | ---: |")
    for kind in KINDS:
        counts = Counter(chosen(known, kind, seed) for seed in range(runs))
        good &= counts[kind] >= ENOUGH * runs
        for found, count in counts.most_common():
            print(
                f"| {kind.degree}, {kind.half_px} | {found.degree}, {found.half_px} | {count} of {runs} |", flush=True
            )
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
