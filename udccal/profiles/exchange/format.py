"""The protocol of a format: how a profile becomes a file's bytes, and how a file's text becomes a lens."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float

from udccal.profiles.exchange.lens import Lens
from udccal.profiles.profile import Profile
from udccal.sessions.schema import TermName


@final
@dataclass(frozen=True)
class Place:
    """Where the entrance pupil is in the panel's frame in mm, its covariance (None: not known), and who tells it."""

    pupil_mm: Float[np.ndarray, "3"]
    cov_mm2: Float[np.ndarray, "3 3"] | None
    what: str


@final
@dataclass(frozen=True)
class ExportFormat:
    """A format that profiles are written in for other programs.

    Attributes:
        name: as on the command line.
        terms: those that a file holds numbers of.
        not_held: sentences that say what a file cannot hold.
        encode: returns the content of a file.
        posed: whether a file holds the camera's place, in mm in the panel's frame.
    """

    name: str
    terms: tuple[TermName, ...]
    not_held: tuple[str, ...]
    encode: Callable[[Profile], bytes]
    posed: bool = False


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
