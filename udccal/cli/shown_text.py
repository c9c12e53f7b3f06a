"""Text for a terminal: whatever a file or a device says, it moves no cursor and changes no title."""

from __future__ import annotations

_CONTROLS = dict.fromkeys({*range(32), *range(127, 160)} - {ord("\t"), ord("\n")}, "?")


def shown(text: str) -> str:
    """Return a text with question marks in place of control characters other than tabs and line ends."""
    return text.translate(_CONTROLS)
