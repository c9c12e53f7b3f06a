"""Which image the psf fit chooses where no diffraction is in the blur, on fields whose degree is known.

    python -m tests.benchmarks.psf_free_orders [--runs N]

Every degree is drawn N times; prints how often which was chosen, and exits with 1 where the right one was in fewer than
95 of 100.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from typing import Final

from tests.scenes.psf_free_orders import DEGREES, chosen

ENOUGH: Final = 0.95


def main() -> int:
    """Run all degrees; the exit status is 0 where the right one is chosen often enough."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=100, help="of every degree")
    runs: int = parser.parse_args().runs
    good = True
    print("| degree | chosen | of runs |\n| ---: | ---: | ---: |")
    for degree in DEGREES:
        counts = Counter(chosen(degree, seed) for seed in range(runs))
        good &= counts[degree] >= ENOUGH * runs
        for found, count in counts.most_common():
            print(f"| {degree} | {found} | {count} of {runs} |", flush=True)
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
