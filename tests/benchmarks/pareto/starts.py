"""Seconds from the start of a program to its first picture, imports and all."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from tests.benchmarks.pareto.first_picture import write_frame
from tests.benchmarks.pareto.restoring import Taken
from tests.benchmarks.rows import Row, at_most
from udccal.compilation import FOLDER_VARIABLE
from udccal.tiers import Tier

# Of a second start, which finds kept arrays and compilations.
_SECOND_S: Final = {Tier.preview: 3.0, Tier.fast: 4.0}
_FIRST_S: Final = 30.0
# Second starts that are measured; the quickest counts, since other programs only add.
_TIMES: Final = 3


@dataclass(frozen=True)
class Start:
    """Seconds to the first picture at a tier: of the first start, and of a later one."""

    tier: Tier
    first_s: float
    second_s: float


def starts_of(profile: str, taken: Taken) -> list[Start]:
    """Start programs that find nothing kept, then programs that find what those have kept.

    Args:
        profile: a profile's path or name.
        taken: a frame; its panel's picture is known.
    """
    return [_start(profile, tier, taken) for tier in _SECOND_S]


def start_rows(starts: Iterable[Start]) -> list[Row]:
    """Every start against its limit."""
    rows = []
    for start in starts:
        rows.append(at_most(f"start s, {start.tier}, second", start.second_s, _SECOND_S[start.tier], "s"))
        rows.append(at_most(f"start s, {start.tier}, first", start.first_s, _FIRST_S, "s"))
    return rows


def _start(profile: str, tier: Tier, taken: Taken) -> Start:
    assert taken.panel_picture is not None
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        file = folder / "frame.npz"
        write_frame(file, taken.frame, taken.exposure_s, taken.panel_picture)
        command = [sys.executable, "-m", "tests.benchmarks.pareto.first_picture", profile, tier]
        command += [str(folder / "prepared"), str(file)]
        environment = {**os.environ, FOLDER_VARIABLE: str(folder / "compilations")}
        first_s = to_first_line_s(command, environment)
        return Start(tier, first_s, min(to_first_line_s(command, environment) for _ in range(_TIMES)))


def to_first_line_s(command: list[str], environment: dict[str, str]) -> float:
    """Seconds until a program says something.

    Raises:
        RuntimeError: when it ends without a word.
    """
    start = time.perf_counter()
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as program:
        assert program.stdout is not None
        line = program.stdout.readline()
        seconds = time.perf_counter() - start
    if not line or program.returncode != 0:
        raise RuntimeError(f"Expected {' '.join(command)} to restore a frame, found exit status {program.returncode}.")
    return seconds
