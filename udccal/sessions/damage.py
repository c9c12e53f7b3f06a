"""Find the files of a session that are missing or changed since they were captured."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from udccal.errors import FileFormatError
from udccal.io.hashing import sha256_file
from udccal.io.links import is_plain_file
from udccal.sessions.schema import Manifest, PanelSubject, StoredStep

_LEFTOVER = re.compile(r"\..+-[0-9a-f]{12}\.partial\.(png|exr|json)")


@dataclass(frozen=True)
class Damage:
    """A damaged file, whose step has to be captured again."""

    step_id: str
    file: str
    what: Literal["missing", "changed", "unreadable"]

    def __str__(self) -> str:
        """Describe the damage to a person."""
        return f"{self.file} of the step {self.step_id} is {self.what}"


def find_damage(folder: Path, manifest: Manifest) -> tuple[Damage, ...]:
    """Compare every file that the manifest names with its checksum; reads the whole session."""
    return tuple(damage for step in manifest.steps for damage in _damage(folder, step))


def remove_leftovers(folder: Path) -> None:
    """Remove the half-written files that a killed process left under temporary names; no other file is touched."""
    for path in folder.rglob(".*.partial.*"):
        if is_leftover(path):
            path.unlink()


def is_leftover(path: Path) -> bool:
    """Return whether a file is half-written and was left by a killed process."""
    return _LEFTOVER.fullmatch(path.name) is not None and path.is_file() and not path.is_symlink()


def _damage(folder: Path, step: StoredStep) -> Iterator[Damage]:
    for name, expected in named_files(step):
        file = folder / name
        if not is_plain_file(folder, file):
            yield Damage(step.id, name, "missing")
            continue
        try:
            found = sha256_file(file)
        except OSError:  # a bad sector, or permissions
            yield Damage(step.id, name, "unreadable")
            continue
        except FileFormatError:  # larger than anything that a capture writes
            yield Damage(step.id, name, "changed")
            continue
        if found != expected:
            yield Damage(step.id, name, "changed")


def named_files(step: StoredStep) -> Iterator[tuple[str, str]]:
    """Yield the files of a step, relative to the session's folder, each with its checksum."""
    for capture in step.captures:
        yield capture.file, capture.sha256
    if isinstance(step.subject, PanelSubject):
        yield step.subject.picture, step.subject.picture_sha256
