"""Write a rig description with planned captures to a new file; everything else stays as written, comments too."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Final

from pydantic import ValidationError

from udccal.errors import RigError
from udccal.io.atomic import write_atomically
from udccal.rig import Captures, RigDescription
from udccal.rig_folders import RIG_FILE, find_rig

# The section from its heading to the next, or to the end.
_SECTION: Final = re.compile(r"^\[captures\][^\n]*\n(?:(?!\[)[^\n]*(?:\n|\Z))*", re.MULTILINE)


def check_absent(path: Path) -> None:
    """Check that nothing exists at a path that is to be written.

    Raises:
        RigError: when something exists there.
    """
    if path.exists() or path.is_symlink():
        raise RigError(f"Expected nothing at {path}, found that it exists. Move it away, or choose another name.")


def write_planned_rig(rig_name: str | Path, captures: Captures, path: Path) -> None:
    """Write the description of a rig with other captures to a new file.

    Args:
        rig_name: name of a known rig, or the folder of its description.
        captures: replace the description's own.
        path: of the new file; missing folders are made.

    Raises:
        RigError: when ``path`` exists or cannot be written, or when the captures of the description cannot be replaced.
    """
    check_absent(path)
    source = find_rig(rig_name) / RIG_FILE
    text = source.read_text(encoding="utf-8")
    planned = with_captures(text, captures)
    try:
        wanted = RigDescription.model_validate({**tomllib.loads(text), "captures": captures.model_dump()})
        changed = RigDescription.model_validate(tomllib.loads(planned)) != wanted
    except (tomllib.TOMLDecodeError, ValidationError):
        changed = True
    if changed:
        raise RigError(
            f"Expected one plain [captures] section in {source} that can be replaced, found another form of it. Write "
            "it as one section with a line per number."
        )
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, planned.encode("utf-8"))
    except OSError as error:
        raise RigError(
            f"Expected to write {path}, found that it cannot be written ({error.strerror}). Choose another place."
        ) from error


def with_captures(text: str, captures: Captures) -> str:
    """The description's text with another block of captures, added at its end where there was none."""
    block = "\n".join(["[captures]", *(f"{name} = {value!r}" for name, value in captures.model_dump().items())]) + "\n"
    before, *after = _SECTION.split(text, maxsplit=1)
    if not after:
        return f"{before.rstrip()}\n\n{block}"
    return before + block + (f"\n{after[0]}" if after[0] else "")
