"""The profile of a rig that changed: what a check has solved for replaces the old, all else stays."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from udccal.comparison.estimates import ANGLES
from udccal.drift.causes import CAUSES
from udccal.drift.check import RigCheck, Solved
from udccal.drift.gain import GainRatio
from udccal.drift.moved import moved_backscatter, moved_geometry, moved_psf, moved_wire, movement_mm
from udccal.fitting.wire.fit import sensor_map
from udccal.mounting import angles_deg
from udccal.profiles.archive import unpack_archive
from udccal.profiles.profile import Profile, build_profile
from udccal.profiles.provenance import profile_sha256, provenance_now
from udccal.profiles.store import find_profile
from udccal.result import FitResult
from udccal.sessions.manifest import MANIFEST_NAME


def updated(profile: Profile, path: Path, found: RigCheck, solved: Solved, session: Path) -> Profile:
    """Return the profile with what the check found significant, and with the old one as its parent.

    Args:
        profile: the rig's.
        path: where it was read from, which gives its SHA-256.
        found, solved: of ``check_rig``.
        session: folder of the check's session.
    """
    significant = {one.name for one in found.changes if one.significant}
    change, wire = solved.cause.values, profile.wire.term
    level = solved.level if "panel level" in significant else np.ones(3)
    gain = next((one for one in found.changes if one.name == "gain" and one.significant), None)
    ratio = GainRatio(1.0, 0.0) if gain is None else GainRatio(solved.gain, gain.sigma / 100)
    results = _results(profile, solved, level, ratio)
    moved = bool(significant & set(CAUSES))
    camera, provenance = profile.rig.camera, provenance_now(session / MANIFEST_NAME, profile.provenance.camera)
    new_map = sensor_map(moved_wire(wire, change), camera.rows, camera.columns) if moved else profile.wire_map
    return build_profile(profile.rig, provenance, *results, np.asarray(new_map, dtype=np.float64), _sha256(path))


def _sha256(path: Path) -> str:
    place = find_profile(path)
    if not place.is_file():
        return profile_sha256(place)
    with tempfile.TemporaryDirectory(prefix="udccal-") as folder:
        unpack_archive(place, Path(folder))
        return profile_sha256(Path(folder))


def _results(
    profile: Profile, solved: Solved, level: Float[np.ndarray, "3"], gain: GainRatio
) -> tuple[FitResult, FitResult, FitResult, FitResult, FitResult]:
    """All terms, those that changed with a note and with other estimates."""
    change, wire = solved.cause.values, profile.wire.term
    pitch = profile.rig.panel.pitch_mm.value
    x, y, z = movement_mm(wire, change, pitch)
    # Of the turn (rad), the logarithm of the stand-off, and the place in periods.
    cov = solved.pose.cov
    geometry = moved_geometry(profile.geometry.term, change)
    before, after = (angles_deg(np.asarray(one.rotation_rad)) for one in (profile.geometry.term, geometry))
    turned = dict(zip(ANGLES, after - before, strict=True)) if change[:3].any() else {}
    focal = {name: value * np.expm1(change[6]) for name, value in _focal(profile).items()} if change[6] else {}
    moves = {"standoff_per_pitch": -z / pitch, "offset_x_periods": x / pitch, "offset_y_periods": y / pitch}
    shifts = {"standoff_mm": -z, "offset_x_px": -x / pitch, "offset_y_px": -y / pitch}
    moved = bool(change[3:6].any())
    by_place = np.diag([float(wire.standoff_per_pitch), 1.0, 1.0])
    largest_deg2 = np.rad2deg(1.0) ** 2 * float(np.diag(cov)[:3].max())
    posed, K = bool(change.any()), float(profile.noise.term.K_DN_per_e)
    return (
        _changed(
            profile.noise,
            replace(profile.noise.term, K_DN_per_e=np.asarray(profile.noise.term.K_DN_per_e) * gain.value),
            gain.value != 1,
            {"K_DN_per_e": K * (gain.value - 1)},
            np.array([[(K * gain.sigma) ** 2]]),
        ),
        _changed(
            profile.geometry,
            geometry,
            bool(change[:3].any() or change[6]),
            turned | focal,
            largest_deg2 * np.eye(len(turned)),
        ),
        _changed(
            profile.wire,
            moved_wire(wire, change),
            posed,
            moves if moved else {},
            by_place @ cov[3:6, 3:6] @ by_place if moved else None,
        ),
        _changed(profile.psf, moved_psf(profile.psf.term, change), posed, {}),
        _changed(
            profile.backscatter,
            moved_backscatter(profile.backscatter.term, wire, change, level),
            posed or bool((level != 1).any()),
            shifts if moved else {},
        ),
    )


def _focal(profile: Profile) -> Mapping[str, float]:
    return {one.name: one.value for one in profile.geometry.estimates if one.name in ("fx", "fy")}


def _changed(
    result: FitResult,
    term: object,
    changed: bool,
    added: Mapping[str, float],
    own_cov: Float[np.ndarray, "some some"] | None = None,
) -> FitResult:
    """The result with another term, with numbers added to its estimates, and the check's covariance of the first ones.

    What changed is no fit of the old captures any more, and does not name them.
    """
    if not changed:
        return result
    cov, by_name = result.cov.copy(), {one.name: i for i, one in enumerate(result.estimates)}
    own_cov = np.zeros((0, 0)) if own_cov is None else own_cov
    own = {by_name[name]: k for k, name in enumerate(list(added)[: len(own_cov)]) if name in by_name}
    sigmas = {i: float(np.sqrt(own_cov[k, k])) for i, k in own.items()}
    inside = [i for i in own if i < len(cov)]
    cov[inside], cov[:, inside] = 0.0, 0.0
    at = [own[i] for i in inside]
    cov[np.ix_(inside, inside)] = own_cov[np.ix_(at, at)]
    estimates = tuple(
        replace(one, value=float(one.value + added.get(one.name, 0.0)), sigma=sigmas.get(i, one.sigma))
        for i, one in enumerate(result.estimates)
    )
    notes = (f"{', '.join(added)} by a check of a few minutes; the other numbers are older.",) if added else ()
    return replace(result, term=term, estimates=estimates, cov=cov, notes=(*result.notes, *notes), captures=None)
