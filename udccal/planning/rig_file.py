"""A rig description with planned captures, as a new file: everything else stays as it was written, comments too."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Final

from pydantic import ValidationError

from udccal.errors import RigError
from udccal.io.atomic import write_atomically
from udccal.rig import Captures, RigDescription, find_rig

# The section from its heading to the next, or to the end.
_SECTION: Final = re.compile(r"^\[captures\][^\n]*\n(?:(?!\[)[^\n]*(?:\n|\Z))*", re.MULTILINE)


def check_absent(path: Path) -> None:
    """Nothing may be at a path that is to be written.

    Raises:
        RigError: when something is.
    """
    if path.exists() or path.is_symlink():
        raise RigError(f"Expected nothing at {path}, found that it exists. Move it away, or choose another name.")


def write_planned_rig(rig_name: str | Path, captures: Captures, path: Path) -> None:
    """Write the description of a rig with other captures to a new file.

    Raises:
        RigError: when something is at ``path`` already, it cannot be written, or the description cannot be taken over.
    """
    check_absent(path)
    source = find_rig(rig_name) / "rig.toml"
    text = source.read_text(encoding="utf-8")
    planned = with_captures(text, captures)
    _check(text, planned, captures, source)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, planned.encode("utf-8"))
    except OSError as error:
        raise RigError(
            f"Expected to write {path}, found that it cannot be written ({error.strerror}). Choose another place."
        ) from error


def with_captures(text: str, captures: Captures) -> str:
    """The description's text with another block of captures; one at its end where there was none."""
    lines = [f"{name} = {value!r}" for name, value in captures.model_dump().items()]
    block = "\n".join(["[captures]", *lines]) + "\n"
    found = _SECTION.search(text)
    if found is None:
        return f"{text.rstrip()}\n\n{block}"
    after = text[found.end() :]
    return text[: found.start()] + block + ("\n" if after else "") + after


def _check(before: str, after: str, captures: Captures, source: Path) -> None:
    """The new text must say what the old one says, but for the captures."""
    try:
        wanted = RigDescription.model_validate({**tomllib.loads(before), "captures": captures.model_dump()})
        found = RigDescription.model_validate(tomllib.loads(after))
    except (tomllib.TOMLDecodeError, ValidationError) as error:
        raise RigError(
            f"Expected a [captures] section in {source} that can be replaced, found: {error}. Write it as one section "
            "with a line per number."
        ) from error
    if found != wanted:
        raise RigError(
            f"Expected one plain [captures] section in {source}, found another form of it. Write it as one section "
            "with a line per number."
        )
