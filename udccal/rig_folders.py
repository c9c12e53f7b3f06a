"""Where rigs are: a person's own folder, the folder of those that ship with udccal, or any path."""

from __future__ import annotations

import os
from importlib import resources
from pathlib import Path
from typing import Final

from udccal.errors import RigError, did_you_mean
from udccal.io.home import home_folder

RIG_FILE: Final = "rig.toml"
# Own rigs that a message names.
_MOST_NAMED: Final = 20


def user_rig_folder() -> Path | None:
    """Return the folder in which a user's own rigs are looked up by name: ``UDCCAL_RIGS``, or a default at home.

    None where neither is there.
    """
    given, home = os.environ.get("UDCCAL_RIGS"), home_folder()
    if given is not None:
        return Path(given)
    return None if home is None else home / ".local" / "share" / "udccal" / "rigs"


def rig_folders() -> tuple[Path, ...]:
    """Return the folders in which rigs are looked up by name: the user's own, if any, then that of shipped ones."""
    own = user_rig_folder()
    return (shipped_rig_folder(),) if own is None else (own, shipped_rig_folder())


def shipped_rig_folder() -> Path:
    """Return the folder of the rigs that ship with udccal."""
    return Path(str(resources.files("rig_profiles")))


def rig_names(folder: Path) -> tuple[str, ...]:
    """Return the names of the rigs in a folder, sorted."""
    return tuple(sorted(file.parent.name for file in folder.glob(f"*/{RIG_FILE}")))


def find_rig(name_or_path: str | Path) -> Path:
    """Return the folder of a rig.

    Args:
        name_or_path: a path, or the name of a rig in the user's folder or among the shipped ones.

    Raises:
        RigError: when no folder with a ``rig.toml`` is found; the message names those that there are.
    """
    path = Path(name_or_path)
    by_name = () if path.parts[1:] or path.is_absolute() else (folder / path for folder in rig_folders())
    for place in (*by_name, path):
        if (place / RIG_FILE).is_file():
            return place
    folder = user_rig_folder()
    own, shipped = () if folder is None else rig_names(folder), rig_names(shipped_rig_folder())
    meant = did_you_mean(path.name, {*own, *shipped})
    yours = f"one of your own ({', '.join(own[:_MOST_NAMED])}), " if own else ""
    raise RigError(
        f"Expected a rig folder with a {RIG_FILE}, found none for '{name_or_path}'.{meant} Give a path, {yours}or one "
        f"of the shipped rigs: {', '.join(shipped)}."
    )
