"""One size of one case, in a process of its own: prints one line of JSON."""

from __future__ import annotations

import importlib
import json
import resource
import sys
import time

from udccal.compilation import compilation_clock


def main() -> None:
    """Arguments: term, growing quantity, size."""
    term, knob, size = sys.argv[1:]
    cases = importlib.import_module(f"tests.benchmarks.growth.{term}").CASES
    (case,) = (c for c in cases if c.knob == knob)
    work = case.prepare(int(size))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    clock = compilation_clock()
    seconds = []
    for _ in range(2):
        start = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - start)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    added = max(peak - before, 0) / 1024.0
    print(json.dumps([seconds[0], clock.seconds, seconds[1], peak / 1024.0, added]))


if __name__ == "__main__":
    main()
