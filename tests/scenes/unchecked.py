"""Data past the tests' own check of types, which programs do not have."""

from __future__ import annotations

import copy
from typing import Any


def unchecked(original: Any, **change: Any) -> Any:
    """A changed copy of a frozen dataclass, with no check."""
    changed = copy.copy(original)
    for name, value in change.items():
        object.__setattr__(changed, name, value)
    return changed


def checked_with(original: Any, change: dict[str, Any]) -> None:
    """Run a frozen dataclass's own checks on a changed copy."""
    unchecked(original, **change).__post_init__()
