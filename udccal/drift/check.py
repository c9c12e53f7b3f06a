"""What has changed at a rig since its profile was made: pose, focus, smudges, the panel's brightness, the gain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, final

import numpy as np
from jaxtyping import Float

from udccal.comparison.comparable import check_same_rig
from udccal.drift.causes import Explained, explained
from udccal.drift.changes import Change, gain_change, panel_level, pose_changes, smudge
from udccal.drift.gain import gain_ratio
from udccal.drift.limits import DriftLimits
from udccal.drift.moved import moved_backscatter, movement_mm
from udccal.drift.pose import PoseChange, pose_change
from udccal.errors import ProfileError, SessionError
from udccal.fitting.backscatter.read import read_backscatter
from udccal.fitting.wire.data import read_wire
from udccal.fitting.wire.fit import unusable_flat
from udccal.fitting.wire.parameters import WireRules
from udccal.numerics import in_float64
from udccal.profiles.profile import Profile
from udccal.rig import RigDescription
from udccal.sessions.store import Session
from udccal.validation.backscatter import SeenLight, brightness, unusable_pictures
from udccal.validation.flats import NO_PARTS

Verdict = Literal["same", "changed, harmless", "changed"]
FORMAT, VERSION = "udccal-check", 1
# Ten flats tell a movement of some micrometres; two pictures beside white tell where on the panel the camera is.
_FEW = {"flats": 10, "backscatter_pictures": 2, "backscatter_frames": 4}
# Flats that no pose explains to this many times their noise were of a rig that changed in another way.
_UNEXPLAINED = 1.5


@final
@dataclass(frozen=True)
class RigCheck:
    """A rig against its profile. docs/check.md describes each number.

    Attributes:
        changed: names of the changes that matter.
        advice: one sentence that says what to do.
        changes: all that were looked for.
        movement_mm: of the camera (x, y, z) in the panel's frame; zero where none was found.
        flat_over_noise: reduced chi-squared of the flat at the pose found.
    """

    format: str
    version: int
    rig: str
    verdict: Verdict
    changed: tuple[str, ...]
    advice: str
    changes: tuple[Change, ...]
    movement_mm: tuple[float, float, float]
    flat_over_noise: float
    limits: DriftLimits

    @property
    def explained(self) -> bool:
        """Whether a pose of the camera explains the flats."""
        return self.flat_over_noise <= _UNEXPLAINED


@final
@dataclass(frozen=True)
class Solved:
    """What a check has solved for: the pose by causes, the panel's level by camera colour, and the gain's ratio."""

    pose: PoseChange
    cause: Explained
    level: Float[np.ndarray, "3"]
    gain: float


def short_rig(rig: RigDescription) -> RigDescription:
    """Return the description of the same rig with the captures of a check."""
    return rig.model_copy(update={"captures": rig.captures.model_copy(update=_FEW)})


@in_float64
def check_rig(profile: Profile, session: Session, limits: DriftLimits | None = None) -> tuple[RigCheck, Solved]:
    """Compare a rig with its profile by a short session: flats and darks of the wire, and pictures on the panel.

    Args:
        profile: of the rig.
        session: with the steps ``wire/flat``, ``wire/dark`` and those of backscatter, as ``udccal check`` captures it.
        limits: of the verdict.

    Raises:
        ProfileError: when the session is of another rig or camera, or the profile lacks a term that this needs.
        SessionError: when steps are missing, flats or panel pictures are clipped or dark, the sensor is too small, or
            a file is missing or damaged.
    """
    limits = limits or DriftLimits()
    check_same_rig(profile, session.rig, session.camera)
    check_measured(profile)
    flat, dark = (session.average(session.step(f"wire/{name}").captures[0]) for name in ("flat", "dark"))
    data = read_wire(session, profile.noise.term, profile.wire.term.geometry)
    if (refused := unusable_flat(data, WireRules())) is not None:
        raise SessionError(f"Expected flats that can be compared, found: {refused[1]} {refused[0].value}")
    gain = gain_ratio(flat, dark, profile.noise, profile.rig.camera.cfa)
    pose = pose_change(profile.wire.term, data)
    if np.isnan(pose.left).all():
        raise SessionError(f"Expected flats that can be compared, found: {NO_PARTS}")
    cause = explained(pose.values, pose.cov + _own_cov(profile), limits.chance)
    level = _level(profile, session, cause) / gain.value
    solved = Solved(pose, cause, level, gain.value)
    changes = (
        *pose_changes(profile, cause, limits),
        smudge(profile, pose, limits),
        panel_level(profile, level, gain.sigma, limits),
        gain_change(gain, limits),
    )
    return _answer(profile, changes, solved, limits), solved


def check_measured(profile: Profile) -> None:
    """Refuse a profile that lacks a term which a check compares with.

    Raises:
        ProfileError: with the names of those that lack.
    """
    missing = [one.name for one in (profile.noise, profile.wire, profile.backscatter) if one.unfitted]
    if missing:
        raise ProfileError(
            f"Expected a profile with noise, wire and backscatter as measured, found no {' and no '.join(missing)}. "
            "Calibrate these terms first: the check compares with them."
        )


def _own_cov(profile: Profile) -> Float[np.ndarray, "7 7"]:
    """Covariance of the profile's own pose in the units of ``PoseChange``, whose focal length counts from this one."""
    cov, whole = profile.wire.cov, np.zeros((7, 7))
    if len(cov) < 6:
        return whole
    unit = np.array([np.pi / 180] * 3 + [1 / float(profile.wire.term.standoff_per_pitch), 1.0, 1.0])
    whole[:6, :6] = cov[:6, :6] * np.outer(unit, unit)
    return whole


def _level(profile: Profile, session: Session, cause: Explained) -> Float[np.ndarray, "3"]:
    """The panel's brightness over the profile's, by camera colour, seen from where the camera is now."""
    term = moved_backscatter(profile.backscatter.term, profile.wire.term, cause.values, np.ones(3))
    shading = profile.wire_map.astype(np.float64)
    data = read_backscatter(session, profile.noise.term, term.geometry, shading)
    if (why := unusable_pictures(data, term)) is not None:
        raise SessionError(f"Expected panel pictures that can be compared, found: {why}")
    return brightness(SeenLight.of(data, replace(profile.backscatter, term=term)))


def _answer(profile: Profile, changes: Sequence[Change], solved: Solved, limits: DriftLimits) -> RigCheck:
    harmful = [one for one in changes if one.harmful]
    odd = solved.pose.variance > _UNEXPLAINED
    verdict: Verdict = "same"
    if harmful or odd:
        verdict = "changed"
    elif any(one.significant for one in changes):
        verdict = "changed, harmless"
    x, y, z = movement_mm(profile.wire.term, solved.cause.values, profile.rig.panel.pitch_mm.value)
    return RigCheck(
        format=FORMAT,
        version=VERSION,
        rig=profile.rig.name,
        verdict=verdict,
        changed=tuple(one.name for one in harmful),
        advice=_advice(harmful, odd, verdict),
        changes=tuple(changes),
        movement_mm=(float(x), float(y), float(z)),
        flat_over_noise=solved.pose.variance,
        limits=limits,
    )


def _advice(harmful: Sequence[Change], odd: bool, verdict: Verdict) -> str:
    if odd:
        return "Calibrate the rig again: no movement of the camera explains how the flats look now."
    if harmful:
        return " ".join(dict.fromkeys([*(one.what for one in harmful), *(one.advice for one in harmful)]))
    if verdict == "same":
        return "Go on with this profile: the rig is as it was."
    return "Go on with this profile: the rig changed, too little to matter."
