"""Feeds a target with broken inputs, guided by which lines of udccal they reach.

python -m tests.fuzz.run gencp --inputs 100000          # one target
python -m tests.fuzz.run --inputs 100000                # all, each in a process of its own

An input that makes a reader crash, hang for five times what it may take (``Target.longest_s``), take 2 GiB, or raise
anything but an udccal error ends its target's run with a non-zero status and is written to the current folder; keep it
in tests/fuzz/kept/<target>/.
A target whose inputs take long gets one in so many of the inputs (``Target.one_in``).
"""

from __future__ import annotations

import argparse
import itertools
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import atheris
import jax

# Atheris never frees what a comparison of arrays gives. Modules that compare whole pictures read no bytes.
_OF_PICTURES = ["udccal.restoration.tone", "udccal.fitting.noise.codes", "udccal.fitting.noise.moments"]

with atheris.instrument_imports(include=["udccal"], exclude=_OF_PICTURES):
    from tests.fuzz.targets import TARGETS

_MEMORY_MIB, _KEPT_COMPILED = 2048, 500
KEPT = Path(__file__).with_name("kept")


def _run_all(inputs: int, names: list[str]) -> int:
    failed = []
    for name in names:
        start = time.monotonic()
        own = max(1, inputs // TARGETS[name].one_in)
        command = [sys.executable, "-m", "tests.fuzz.run", name, "--inputs", str(own), "--here"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        verdict = "ok" if done.returncode == 0 else "FAILED"
        print(f"{name:12} {own} inputs {time.monotonic() - start:7.0f} s  {verdict}", flush=True)
        if done.returncode != 0:
            failed.append(name)
            print(done.stdout[-1000:] + done.stderr[-4000:], flush=True)
    return 1 if failed else 0


def _run_here(name: str, inputs: int) -> None:
    target = TARGETS[name]
    with tempfile.TemporaryDirectory(prefix="udccal-corpus-") as folder:
        kept = sorted((KEPT / name).glob("*")) if (KEPT / name).is_dir() else []
        for index, seed in enumerate((*target.seeds(), *(path.read_bytes() for path in kept))):
            (Path(folder) / str(index)).write_bytes(seed)
        options = [
            f"-runs={inputs}",
            f"-timeout={round(5 * target.longest_s)}",
            f"-rss_limit_mb={_MEMORY_MIB}",
            f"-max_len={target.max_bytes}",
            "-seed=1",
            "-print_final_stats=1",
        ]
        number = itertools.count(1)

        def tried(data: bytes) -> None:
            target.try_out(data)
            # Targets that take long compile for every size that an input changes, and JAX keeps all of that.
            if target.one_in > 1 and next(number) % _KEPT_COMPILED == 0:
                jax.clear_caches()

        atheris.Setup([sys.argv[0], *options, folder], tried)
        atheris.Fuzz()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("targets", nargs="*")
    parser.add_argument("--inputs", type=int, default=100_000)
    parser.add_argument("--here", action="store_true", help="one target in this process")
    arguments = parser.parse_args()
    unknown = [name for name in arguments.targets if name not in TARGETS]
    if unknown:
        parser.error(f"expected targets among {', '.join(TARGETS)}, found {', '.join(unknown)}")
    if arguments.here:
        _run_here(arguments.targets[0], arguments.inputs)
    else:
        sys.exit(_run_all(arguments.inputs, arguments.targets or list(TARGETS)))


if __name__ == "__main__":
    main()
