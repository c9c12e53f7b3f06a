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
from udccal.profiles.exchange.format import ExportFormat, Place
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
class _StoredPlace:
    """Of the camera, in the panel's frame; ``what`` says who tells it, and the rest is null where nobody does."""

    what: str
    pupil_mm: list[float]
    sigma_mm: list[float] | None
    covariance_mm2: list[list[float]] | None


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
    place: _StoredPlace | None


def covariance_file(path: Path) -> Path:
    """Return where the covariance of an exported file goes: its name with ``.json`` after it."""
    return Path(f"{path}.json")


def export_profile(profile: Profile, to: ExportFormat, path: Path, place: Place | None = None) -> None:
    """Write a profile for another program, with the covariance beside it.

    Args:
        profile: the rig as measured.
        to: the format.
        place: of the camera, for formats that hold it; None for the geometry term's own, which is nominal.
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
    place = place if to.posed else None
    content = to.encode(profile if place is None else _placed(profile, place))
    known = dataclasses.asdict(_covariances(profile, to, place))
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(beside, json.dumps(known, indent=1, allow_nan=False).encode("utf-8") + b"\n")
    try:
        write_atomically(path, content)
    except BaseException:  # Ctrl-C too
        beside.unlink(missing_ok=True)
        raise


def _placed(profile: Profile, place: Place) -> Profile:
    term = dataclasses.replace(profile.geometry.term, pupil_mm=place.pupil_mm)
    return dataclasses.replace(profile, geometry=dataclasses.replace(profile.geometry, term=term))


def _covariances(profile: Profile, to: ExportFormat, place: Place | None) -> _Covariances:
    made, results = profile.provenance, [profile.result(name) for name in to.terms]
    terms = tuple(_TermCovariance(r.name, r.status.name, r.estimates, np.asarray(r.cov).tolist()) for r in results)
    return _Covariances(
        FORMAT,
        VERSION,
        profile.rig.name,
        made.created_at,
        made.session_sha256,
        to.name,
        to.not_held,
        terms,
        None if place is None else _stored_place(place),
    )


def _stored_place(place: Place) -> _StoredPlace:
    cov = place.cov_mm2
    sigma = None if cov is None else np.sqrt(np.diag(cov)).tolist()
    return _StoredPlace(place.what, place.pupil_mm.tolist(), sigma, None if cov is None else cov.tolist())
