"""Runs tests on a real USB stack: boots Debian's stock kernel in qemu with the host's own files as its root.

    python -m tests.usb_stack [--limit-s SECONDS] [--if-possible] [pytest's arguments]

The exit status is pytest's; 2 and a sentence when the guest cannot be had or fails.
"""

from __future__ import annotations

import argparse
import shlex
import sys
import tempfile
from pathlib import Path

from tests.usb_stack.errors import CannotRun, GuestFailed
from tests.usb_stack.host import busybox, check_host
from tests.usb_stack.initramfs import initramfs
from tests.usb_stack.kernel import kernel_in
from tests.usb_stack.machine import run_guest
from tests.usb_stack.needs import PROMISED

_REPOSITORY = Path(__file__).resolve().parents[2]
_CACHE = _REPOSITORY / ".cache-usb"
_LIMIT_S = 1800.0
# Without plug-ins that these tests do not use and that take long to import on an emulated processor. Verbose, so that
# pytest says how many tests passed.
_PYTEST = ("-m", "pytest", "-v", "-p", "no:cacheprovider", "-p", "no:hypothesispytest", "-p", "no:xdist")
_FAILED = 2


def main() -> int:
    """Boot, run, and return the tests' exit status."""
    parser = argparse.ArgumentParser(prog="python -m tests.usb_stack", description=__doc__)
    parser.add_argument("--limit-s", type=float, default=_LIMIT_S, help="longest time for the tests in the guest")
    parser.add_argument("--if-possible", action="store_true", help="exit status 0 where the guest cannot be had")
    own, rest = parser.parse_known_args()
    command = shlex.join([sys.executable, *_PYTEST, *_with_tests(rest)])
    # Standard error goes the same way, so that lines come in the order in which they were written.
    settings = f"HOME=/tmp PYTHONDONTWRITEBYTECODE=1 {PROMISED}=1"
    inside = f"cd {shlex.quote(str(_REPOSITORY))} && {settings} {command} 2>&1"
    try:
        check_host()
        kernel = kernel_in(_CACHE)
        with tempfile.TemporaryDirectory() as folder:
            archive = Path(folder) / "initramfs.cpio"
            archive.write_bytes(initramfs(kernel, busybox(), inside))
            return run_guest(kernel.image, archive, own.limit_s)
    except CannotRun as reason:
        print(f"The USB tests were not run. {reason}", file=sys.stderr)
        return 0 if own.if_possible else _FAILED
    except GuestFailed as reason:
        print(reason, file=sys.stderr)
        return _FAILED


def _with_tests(arguments: list[str]) -> list[str]:
    """pytest's arguments, with these tests where none are named: options alone would mean every test there is."""
    named = any((_REPOSITORY / argument.split("::")[0]).exists() for argument in arguments)
    return arguments if named else [*arguments, "tests/usb_stack"]


if __name__ == "__main__":
    sys.exit(main())
