"""The works with known truth that udccal and its peers are measured on, from the folder that holds them."""

from __future__ import annotations

import argparse
import importlib
import os
import resource
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Generic, TypeVar

Result = TypeVar("Result")


def arguments(description: str | None) -> argparse.ArgumentParser:
    """A parser with ``--peers``, the folder of works.py, which every script here needs."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--peers", type=Path, default=Path("../shared/peers"), help="folder of works.py")
    return parser


def load(folder: Path) -> ModuleType:
    """The module works.py of ``folder``. Generated inputs go to $PEERS_OUT, or the temporary folder.

    Raises:
        SystemExit: when there is none.
    """
    if not (folder / "works.py").is_file():
        sys.exit(f"Expected works.py in {folder}, found none. Give its folder with --peers.")
    os.environ.setdefault("PEERS_OUT", str(Path(tempfile.gettempdir()) / "peers" / "data"))
    sys.path.insert(0, str(folder.resolve()))
    return importlib.import_module("works")


@dataclass(frozen=True)
class Timed(Generic[Result]):
    """The result, the first call's seconds (compilation included) and the median of the others."""

    result: Result
    first_s: float
    seconds: float


def timed(work: Callable[[], Result], repeats: int = 5) -> Timed[Result]:
    """Run once for compilation, then ``repeats`` times."""
    taken = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        result = work()
        taken.append(time.perf_counter() - start)
    return Timed(result, taken[0], sorted(taken[1:])[repeats // 2])


def peak_MiB() -> float:
    """Peak memory of this process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
