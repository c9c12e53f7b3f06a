"""A live run of the simulated camera, through the command: frames dropped, latency, and memory.

python -m tests.benchmarks.live --minutes 10

Ten minutes of the defaults go into docs/live.md.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import psutil

from tests.benchmarks.readme_tables import put_table
from tests.benchmarks.rows import Row, at_most, table, write_json

_PAGE = Path(__file__).resolve().parents[2] / "docs" / "live.md"
_PROFILE, _TIER, _MINUTES = "lg55-reduced", "preview", 10.0
_DROPPED_PERCENT, _LATENCY_MS, _MEMORY_MIB = 1.0, 66.0, 20.0
# Memory counts from here on: by then everything is loaded, and every buffer has been used.
_SETTLED_S = 10
_MIB = 1024 * 1024


@dataclass(frozen=True)
class Measured:
    """What a run's log says in the end, and the resident memory of its process in MiB from second to second."""

    captured: int
    dropped: int
    latency_p95_ms: float
    memory_MiB: tuple[float, ...]


def measure(profile: str, tier: str, seconds: float) -> Measured:
    """Run with frames to shared memory that nobody reads."""
    with tempfile.TemporaryDirectory() as folder:
        log, name = Path(folder) / "log.jsonl", Path(folder).name
        limits = ["--fps", "30", "--seconds", str(seconds), "--log", str(log)]
        words = ["run", "--profile", profile, "--tier", tier, "--sink", f"shm:{name}", *limits]
        with subprocess.Popen([sys.executable, "-m", "udccal.cli.main", *words]) as running:
            memory = tuple(_memory(running, log))
        if running.returncode != 0:
            raise RuntimeError("expected the run to end well, found the error above")
        whole = json.loads(log.read_text().splitlines()[-1])
    dropped = sum(whole[f"dropped_{where}"] for where in ("by_camera", "before_restoration", "before_output"))
    latency = whole["latency_ms"]["p95"]
    return Measured(whole["captured"], dropped, float("nan") if latency is None else latency, memory)


def _memory(running: subprocess.Popen[bytes], log: Path) -> list[float]:
    """Look once a second, from when the run has settled until its log ends: memory is given back after that."""
    memory: list[float] = []
    while running.poll() is None:
        time.sleep(1.0)
        now = psutil.Process(running.pid).memory_info().rss / _MIB if psutil.pid_exists(running.pid) else 0.0
        lines = log.read_text().splitlines() if log.exists() else []
        if len(lines) >= _SETTLED_S and '"whole"' not in lines[-1]:
            memory.append(now)
    return memory


def judged(measured: Measured) -> list[Row]:
    """The limits of a live run at 30 Hz; a run without frames, or too short to settle, misses them."""
    memory, frames = measured.memory_MiB, measured.captured
    dropped = 100.0 * measured.dropped / frames if frames else float("nan")
    change = max((abs(each - memory[0]) for each in memory), default=float("nan"))
    return [
        at_most("live: frames dropped", dropped, _DROPPED_PERCENT, "%"),
        at_most("live: latency, p95", measured.latency_p95_ms, _LATENCY_MS, "ms"),
        at_most("live: change of memory after the first seconds", change, _MEMORY_MIB, "MiB"),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--profile", default=_PROFILE)
    parser.add_argument("--tier", default=_TIER)
    parser.add_argument("--minutes", type=float, default=_MINUTES)
    parser.add_argument("--out", type=Path, default=Path("live.json"))
    arguments = parser.parse_args()
    rows = judged(measure(arguments.profile, arguments.tier, 60.0 * arguments.minutes))
    write_json(rows, arguments.out)
    print(table(rows))
    if (arguments.profile, arguments.tier) == (_PROFILE, _TIER) and arguments.minutes >= _MINUTES:
        put_table(_PAGE, "live", table(rows))
    sys.exit(0 if all(row.ok for row in rows) else 1)


if __name__ == "__main__":
    main()
