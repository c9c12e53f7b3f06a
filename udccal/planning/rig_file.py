"""Write a rig description with planned captures to a new file; everything else stays as written, comments too."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Final

from pydantic import ValidationError

from udccal.errors import RigError
from udccal.io.atomic import write_atomically
from udccal.io.out_folder import storing_in
from udccal.rig import Captures, RigDescription
from udccal.rig_folders import RIG_FILE, find_rig

# The section from its heading to its last number; what follows belongs to the next section.
_SECTION: Final = re.compile(r"^\[captures\].*\n(?:(?:[ \t]*(?:#.*)?\n)*\w.*(?:\n|\Z))*", re.MULTILINE)


def check_absent(path: Path) -> None:
    """Check that nothing exists at a path that is to be written.

    Raises:
        RigError: when something exists there.
    """
    if path.exists() or path.is_symlink():
        raise RigError(f"Expected nothing at {path}, found that it exists. Move it away, or choose another name.")


def write_planned_rig(rig_name: str | Path, captures: Captures, path: Path) -> None:
    """Write the description of a known rig, or of one in a folder, with other captures to a new file.

    Missing folders are made.

    Raises:
        RigError: when ``path`` exists, or when the captures of the description cannot be replaced.
        UdccalError: when ``path`` cannot be written.
    """
    check_absent(path)
    source = find_rig(rig_name) / RIG_FILE
    text = source.read_text(encoding="utf-8-sig")
    numbers = "".join(f"{name} = {value!r}\n" for name, value in captures.model_dump().items())
    planned, found = _SECTION.subn(f"[captures]\n{numbers}", text, count=1)
    if not found:
        planned = f"{text.rstrip()}\n\n[captures]\n{numbers}"
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
    with storing_in(path.parent):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, planned.encode("utf-8"))
