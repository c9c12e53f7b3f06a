"""Prepares restoration with a profile ahead of its first frame."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

from udccal.cli.output import Output
from udccal.compilation import FOLDER_VARIABLE, keep_compilations, private_folder
from udccal.errors import RestorationError
from udccal.restoration.prepared import prepared_bytes, prepared_folder
from udccal.restoration.runtime import Restorer
from udccal.tiers import Tier


@dataclass(frozen=True)
class PreparedSummary:
    """Result of ``profile prepare``.

    Attributes:
        profile: the profile.
        tier: the tier.
        folder: where the arrays are kept.
        seconds: wall time, in which the profile was read too.
        bytes: size of all that is kept there, of every profile.
    """

    profile: Path
    tier: Tier
    folder: Path
    seconds: float
    bytes: int


def prepare_profile(output: Output, path: Path, tier: Tier) -> None:
    """Compute what restoration needs of a profile, and keep it.

    Args:
        output: shows the time and the size.
        path: folder or zip file of the profile, or a rig's name.
        tier: how much restoration does to a frame.

    Raises:
        ProfileError: when the profile cannot be read.
        RestorationError: when its terms give no finite values, or nothing can be kept.
    """
    folder = prepared_folder()
    if not private_folder(folder):
        raise RestorationError(
            f"Expected a folder {folder} that its owner alone may write to, found none and could not make it. "
            f"Set {FOLDER_VARIABLE} to a folder of your own."
        )
    keep_compilations()
    start = time.perf_counter()
    with output.stage("preparing"):
        Restorer.load(path, tier, keep=folder)
    seconds, size = time.perf_counter() - start, prepared_bytes(folder)
    output.say(f"{folder} holds {size / 1e6:.1f} MB, those of other profiles included.")
    output.result(PreparedSummary(path, tier, folder, seconds, size))
