"""Format versions of the rig description: an older one is read as the present one."""

from __future__ import annotations

from typing import Any, Final

VERSION: Final = 2
# Of ``panel``, from version 1 to 2: one quantity has one name (docs/conventions.md).
_PANEL: Final = {
    "row_open_fraction": "row_open",
    "column_open_fraction": "column_open",
    "structure_thickness_mm": "depth_mm",
}


def present_rig(found: Any) -> Any:
    """The description in the words of the present version; what is not of version 1 comes back as it is."""
    if not isinstance(found, dict) or found.get("version") != 1 or isinstance(found["version"], bool):
        return found
    panel = found.get("panel")
    if isinstance(panel, dict):
        panel = {_PANEL.get(name, name): value for name, value in panel.items()}
    return {**found, "version": VERSION, "panel": panel}
