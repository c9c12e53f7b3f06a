"""The profile of a rig that changed: what a check has solved for replaces the old, all else stays."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from udccal.comparison.estimates import ANGLES
from udccal.drift.causes import CAUSES, Explained
from udccal.drift.check import RigCheck, Solved
from udccal.drift.gain import GainRatio
from udccal.drift.moved import moved_backscatter, moved_geometry, moved_psf, moved_wire, movement_mm
from udccal.fitting.wire.fit import sensor_map
from udccal.models.geometry import Geometry
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
    causes = [name for name, places in CAUSES.items() if change[np.array(places)].any()]
    turns = [name for name in causes if name != "moved"]
    lit = [f"panel level {', '.join(f'{100 * one:.1f}' for one in level)} %"] if (level != 1).any() else []
    geometry, light = moved_geometry(profile.geometry.term, change), profile.backscatter.term
    K = float(profile.noise.term.K_DN_per_e)
    noise = _shifted(profile.noise, {"K_DN_per_e": K * (gain.value - 1)}, np.array([[(K * gain.sigma) ** 2]]))
    noise_term = replace(profile.noise.term, K_DN_per_e=np.asarray(profile.noise.term.K_DN_per_e) * gain.value)
    return (
        _changed(profile.noise, noise, noise_term, ["gain"] if gain.value != 1 else []),
        _changed(profile.geometry, _turned(profile, geometry, solved.cause), geometry, turns),
        _changed(profile.wire, _moved(profile, solved.cause), moved_wire(wire, change), causes),
        _changed(profile.psf, profile.psf, moved_psf(profile.psf.term, change), causes),
        _changed(
            profile.backscatter,
            _moved_light(profile, solved.cause),
            moved_backscatter(light, wire, change, level),
            [*causes, *lit],
        ),
    )


def _turned(profile: Profile, geometry: Geometry, cause: Explained) -> FitResult:
    """The geometry's result with the angles of the check, and its focal lengths times the check's change of them."""
    result, change = profile.geometry, cause.values
    if change[:3].any():
        before, after = (angles_deg(np.asarray(one.rotation_rad)) for one in (profile.geometry.term, geometry))
        largest_deg2 = np.rad2deg(1.0) ** 2 * float(np.diag(cause.cov)[:3].max())
        result = _shifted(result, dict(zip(ANGLES, after - before, strict=True)), largest_deg2 * np.eye(3))
    if change[6]:
        focal = {one.name: one.value for one in result.estimates if one.name in ("fx", "fy")}
        by_focal = np.array(list(focal.values())) * np.exp(change[6])
        shifts = {name: value * float(np.expm1(change[6])) for name, value in focal.items()}
        result = _shifted(result, shifts, cause.cov[6, 6] * np.outer(by_focal, by_focal), onto=True)
    return result


def _moved(profile: Profile, cause: Explained) -> FitResult:
    """The wire's result with the place of the check."""
    if not cause.values[3:6].any():
        return profile.wire
    x, y, z = movement_mm(profile.wire.term, cause.values, 1.0)
    by_place = np.diag([_away(profile, cause), 1.0, 1.0])
    shifts = {"standoff_per_pitch": -z, "offset_x_periods": x, "offset_y_periods": y}
    return _shifted(profile.wire, shifts, by_place @ cause.cov[3:6, 3:6] @ by_place)


def _moved_light(profile: Profile, cause: Explained) -> FitResult:
    """The result of backscatter at its own place and the check's movement from there."""
    if not cause.values[3:6].any():
        return profile.backscatter
    pitch = float(profile.backscatter.term.pitch_mm)
    x, y, z = movement_mm(profile.wire.term, cause.values, 1.0)
    by_place = np.diag([pitch * _away(profile, cause), -1.0, -1.0])
    shifts = {"standoff_mm": -pitch * z, "offset_x_px": -x, "offset_y_px": -y}
    return _shifted(profile.backscatter, shifts, by_place @ cause.cov[3:6, 3:6] @ by_place, onto=True)


def _away(profile: Profile, cause: Explained) -> float:
    """Derivative of the stand-off in pitches by its logarithm."""
    return float(profile.wire.term.standoff_per_pitch) * float(np.exp(cause.values[3]))


def _shifted(
    result: FitResult, shifts: Mapping[str, float], cov: Float[np.ndarray, "n n"], onto: bool = False
) -> FitResult:
    """The result with numbers added to its estimates, and with these numbers' covariance.

    ``onto`` adds it to that of the estimates, which then begin from the old ones; else it replaces theirs.
    """
    by_name = {one.name: i for i, one in enumerate(result.estimates)}
    own = {by_name[name]: k for k, name in enumerate(shifts) if name in by_name}
    inside = [i for i in own if i < len(result.cov)]
    block, whole = cov[np.ix_([own[i] for i in inside], [own[i] for i in inside])], result.cov.copy()
    if onto:
        whole[np.ix_(inside, inside)] += block
    else:
        whole[inside], whole[:, inside] = 0.0, 0.0
        whole[np.ix_(inside, inside)] = block
    estimates = list(result.estimates)
    for i, k in own.items():
        one, sigma = estimates[i], float(np.sqrt(cov[k, k]))
        sigma = float(np.hypot(one.sigma, sigma)) if onto else sigma
        estimates[i] = replace(one, value=float(one.value + shifts[one.name]), sigma=sigma)
    return replace(result, estimates=tuple(estimates), cov=whole)


def _changed(old: FitResult, new: FitResult, term: object, why: Sequence[str]) -> FitResult:
    """The result of a term that a check changed for some reasons, in a note; without one, the old result.

    What changed is no fit of the old captures any more, and does not name them.
    """
    if not why:
        return old
    names = [one.name for one, before in zip(new.estimates, old.estimates, strict=True) if one.value != before.value]
    numbers = f"it found {', '.join(names)}, the other numbers are older" if names else "its numbers are older"
    focus = " After a change of focus, the psf needs a calibration." if new.name == "psf" and "refocused" in why else ""
    note = f"Changed by a check of a few minutes ({', '.join(why)}): {numbers}.{focus}"
    return replace(new, term=term, notes=(*old.notes, note), captures=None)
