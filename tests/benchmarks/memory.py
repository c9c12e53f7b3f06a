"""The peak of this process's resident memory, which Linux can set back."""

from __future__ import annotations

from pathlib import Path

# The system's counters of this process; writing 5 sets the peak of its memory back.
_STATUS, _RESET, _RESET_PEAK = Path("/proc/self/status"), Path("/proc/self/clear_refs"), "5"


def reset_peak() -> None:
    """Begin anew with the memory that is resident now."""
    _RESET.write_text(_RESET_PEAK)


def peak_MiB() -> float:
    """Peak since it was set back."""
    lines = _STATUS.read_text().splitlines()
    return int(next(line for line in lines if line.startswith("VmHWM")).split()[1]) / 1024
