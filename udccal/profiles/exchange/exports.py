"""Exports: a file for another program, and beside it the covariance of its numbers as JSON."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np

from udccal.errors import ProfileError
from udccal.io.atomic import write_atomically
from udccal.profiles.exchange.format import ExportFormat
from udccal.profiles.profile import Profile
from udccal.result import FitResult

FORMAT, VERSION = "udccal-covariance", 1


def covariance_file(path: Path) -> Path:
    """Return where the covariance of an exported file goes: its name with ``.json`` after it."""
    return path.with_name(f"{path.name}.json")


def export_profile(profile: Profile, to: ExportFormat, path: Path) -> None:
    """Write a profile for another program, with the covariance beside it.

    Args:
        profile: the rig as measured.
        to: the format.
        path: the new file; ``covariance_file(path)`` is written, too.

    Raises:
        ProfileError: when one of the two is there already; nothing is written then.
        OSError: when one cannot be written; the other is not left behind.
    """
    beside = covariance_file(path)
    for file in (path, beside):
        if os.path.lexists(file):
            raise ProfileError(f"Expected a new file, found that {file} exists. Remove it, or choose another name.")
    content = to.encode(profile)
    write_atomically(beside, json.dumps(_covariances(profile, to), indent=1, allow_nan=False).encode("utf-8") + b"\n")
    try:
        write_atomically(path, content)
    except OSError:
        beside.unlink(missing_ok=True)
        raise


def _covariances(profile: Profile, to: ExportFormat) -> dict[str, object]:
    made = profile.provenance
    return {
        "format": FORMAT,
        "version": VERSION,
        "rig": profile.rig.name,
        "created_at": made.created_at,
        "session_sha256": made.session_sha256,
        "exported_to": to.name,
        "not_held": list(to.not_held),
        "terms": [_term(profile.result(name)) for name in to.terms],
    }


def _term(result: FitResult) -> dict[str, object]:
    """Covariance of the leading estimates, in products of their units."""
    return {
        "term": result.name,
        "status": result.status.name,
        "estimates": [
            {"name": e.name, "value": float(e.value), "sigma": float(e.sigma), "unit": e.unit} for e in result.estimates
        ],
        "covariance": np.asarray(result.cov, dtype=np.float64).tolist(),
    }
