"""The protocol of a format: how a profile becomes a file's bytes, and how a file's text becomes a lens."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import final

from udccal.profiles.exchange.lens import Lens
from udccal.profiles.profile import Profile
from udccal.sessions.schema import TermName


@final
@dataclass(frozen=True)
class ExportFormat:
    """A format that profiles are written in for other programs.

    Attributes:
        name: as on the command line.
        terms: those that a file holds numbers of.
        not_held: sentences that say what a file cannot hold.
        encode: returns the content of a file.
    """

    name: str
    terms: tuple[TermName, ...]
    not_held: tuple[str, ...]
    encode: Callable[[Profile], bytes]


@final
@dataclass(frozen=True)
class ImportFormat:
    """A format of which the lens is read.

    Attributes:
        name: as on the command line.
        decode: returns the lens in a file's text; raises a ProfileError that names the file, its second argument.
    """

    name: str
    decode: Callable[[str, str], Lens]
