"""Exports: a file for another program, and beside it the covariance of its numbers as JSON."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import final

import numpy as np

from udccal.errors import ProfileError
from udccal.io.atomic import write_atomically
from udccal.profiles.exchange import estimates_csv, mrcal, npz, opencv_yaml, ros_camera_info
from udccal.profiles.exchange.format import ExportFormat
from udccal.profiles.profile import Profile
from udccal.profiles.store import check_outside_profiles
from udccal.result import Estimate

FORMAT, VERSION = "udccal-covariance", 1
EXPORTS: Mapping[str, ExportFormat] = {
    module.EXPORT.name: module.EXPORT for module in (opencv_yaml, ros_camera_info, mrcal, npz, estimates_csv)
}


@final
@dataclass(frozen=True)
class _TermCovariance:
    """Of one term; ``covariance`` is that of the leading estimates, in products of their units."""

    term: str
    status: str
    estimates: tuple[Estimate, ...]
    covariance: list[list[float]]


@final
@dataclass(frozen=True)
class _Covariances:
    """What the file beside an export holds; docs/profile.md describes it."""

    format: str
    version: int
    rig: str
    created_at: str
    session_sha256: str | None
    exported_to: str
    not_held: tuple[str, ...]
    terms: tuple[_TermCovariance, ...]


def covariance_file(path: Path) -> Path:
    """Return where the covariance of an exported file goes: its name with ``.json`` after it."""
    return Path(f"{path}.json")


def export_profile(profile: Profile, to: ExportFormat, path: Path) -> None:
    """Write a profile for another program, with the covariance beside it.

    Args:
        profile: the rig as measured.
        to: the format.
        path: the new file; ``covariance_file(path)`` is written, too.

    Raises:
        ProfileError: when one of the two is there already, or would be inside a profile; nothing is written then.
        OSError: when one cannot be written; the other is not left behind.
    """
    beside = covariance_file(path)
    check_outside_profiles(path)
    for file in (path, beside):
        if os.path.lexists(file):
            raise ProfileError(f"Expected a new file, found that {file} exists. Remove it, or choose another name.")
    content, known = to.encode(profile), dataclasses.asdict(_covariances(profile, to))
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(beside, json.dumps(known, indent=1, allow_nan=False).encode("utf-8") + b"\n")
    try:
        write_atomically(path, content)
    except BaseException:  # Ctrl-C too
        beside.unlink(missing_ok=True)
        raise


def _covariances(profile: Profile, to: ExportFormat) -> _Covariances:
    made, results = profile.provenance, [profile.result(name) for name in to.terms]
    terms = tuple(_TermCovariance(r.name, r.status.name, r.estimates, np.asarray(r.cov).tolist()) for r in results)
    return _Covariances(
        FORMAT, VERSION, profile.rig.name, made.created_at, made.session_sha256, to.name, to.not_held, terms
    )
