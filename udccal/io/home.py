"""The home folder of the user, who may have none, as in a container that runs as a bare number."""

from __future__ import annotations

from pathlib import Path


def home_folder() -> Path | None:
    """Return the user's home folder; None where the system knows none."""
    try:
        return Path.home()
    except RuntimeError:
        return None
