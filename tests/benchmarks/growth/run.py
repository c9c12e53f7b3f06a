"""`make growth`: seconds and peak memory of every fit as frames, field positions and pixels double."""

from __future__ import annotations

import argparse
import importlib
import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from tests.benchmarks.growth.cases import Case
from tests.benchmarks.readme_tables import put_table

_ROOT = Path(__file__).resolve().parents[3]
_PAGE = _ROOT / "docs" / "numerics.md"
MODULES = ("noise", "hdr", "geometry", "wire", "psf", "psf_stamps", "backscatter")


@dataclass(frozen=True)
class Growth:
    """Seconds of the first and the second run, those of the first that went into compiling, and memory in MiB.

    ``peak_MiB`` is the whole process's, data and libraries included; ``added_MiB`` what the work added to it.
    """

    case: Case
    size: int
    first_s: float
    compilation_s: float
    second_s: float
    peak_MiB: float
    added_MiB: float


def measure(case: Case, size: int) -> Growth:
    """In a process of its own, so that memory is its own and nothing is compiled yet."""
    command = [sys.executable, "-m", "tests.benchmarks.growth.one", case.term, case.knob, str(size)]
    environment = {**os.environ, "TF_CPP_MIN_LOG_LEVEL": "3"}
    done = subprocess.run(command, cwd=_ROOT, env=environment, capture_output=True, text=True, check=True)
    return Growth(case, size, *json.loads(done.stdout.splitlines()[-1]))


def table(rows: list[Growth]) -> str:
    """Markdown."""
    head = [
        "| term | what doubles | size | first run, s | of it compiling | again, s | added memory, MiB | peak, MiB |",
        "| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    body = [
        f"| {r.case.term} | {r.case.knob} | {r.size} | {r.first_s:.2f} | {r.compilation_s:.2f} | {r.second_s:.2f} | "
        f"{r.added_MiB:.0f} | {r.peak_MiB:.0f} |"
        for r in rows
    ]
    return "\n".join(head + body)


def main() -> None:
    """Measure the chosen terms, and put each one's table into docs/numerics.md."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("terms", nargs="*", default=[], choices=[[], *MODULES], metavar="term")
    terms = parser.parse_args().terms or list(MODULES)
    for term in terms:
        rows: list[Growth] = []
        for case in importlib.import_module(f"tests.benchmarks.growth.{term}").CASES:
            for size in case.sizes:
                rows.append(measure(case, size))
                print(table(rows[-1:]).splitlines()[-1], flush=True)
        put_table(_PAGE, f"growth {term}", table(rows))


if __name__ == "__main__":
    main()
