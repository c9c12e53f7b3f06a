"""What has changed at a rig since its profile was made: pose, focus, smudges, the panel's brightness, the gain."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, final

import numpy as np
from jaxtyping import Float
from scipy.special import ndtri

from udccal.comparison.comparable import check_same_rig
from udccal.drift.causes import CAUSES, Explained, explained
from udccal.drift.gain import gain_ratio
from udccal.drift.limits import DriftLimits
from udccal.drift.moved import moved_backscatter, movement_mm
from udccal.drift.pose import PoseChange, pose_change
from udccal.errors import SessionError
from udccal.fitting.backscatter.data import read_backscatter
from udccal.fitting.wire.data import read_wire
from udccal.numerics import in_float64
from udccal.profiles.profile import Profile
from udccal.sessions.store import Session
from udccal.validation.backscatter import SeenLight, brightness
from udccal.validation.flats import CELLS

Verdict = Literal["same", "changed, harmless", "changed"]
FORMAT, VERSION = "udccal-check", 1
# Flats that no pose explains to this many times their noise were of a rig that changed in another way.
_UNEXPLAINED = 1.5


@final
@dataclass(frozen=True)
class Change:
    """One possible change of a rig.

    Attributes:
        name: moved, tilted, refocused, smudge, panel level or gain.
        value, sigma, limit: how much it is, one standard deviation, and how much is harmless, in ``unit``.
        significant: whether chance does not explain it.
        what: one plain sentence.
        advice: what to do where it matters.
    """

    name: str
    value: float
    sigma: float
    limit: float
    unit: str
    significant: bool
    what: str
    advice: str

    @property
    def harmful(self) -> bool:
        """Whether it is real and beyond its limit."""
        return self.significant and self.value > self.limit


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


@final
@dataclass(frozen=True)
class Solved:
    """What a check has solved for: the pose by causes, the panel's level by camera colour, and the gain's ratio."""

    pose: PoseChange
    cause: Explained
    level: Float[np.ndarray, "3"]
    gain: float


@in_float64
def check_rig(profile: Profile, session: Session, limits: DriftLimits | None = None) -> tuple[RigCheck, Solved]:
    """Compare a rig with its profile by a short session: flats and darks of the wire, and pictures on the panel.

    Args:
        profile: of the rig.
        session: with the steps ``wire/flat``, ``wire/dark`` and those of backscatter, as ``udccal check`` captures it.
        limits: of the verdict.

    Raises:
        ProfileError: when the session is of another rig or camera.
        SessionError: when steps are missing, or a file is missing or damaged.
    """
    limits = limits or DriftLimits()
    check_same_rig(profile, session.rig, session.camera)
    missing = {"wire/flat", "wire/dark"} - {step.id for step in session.steps("wire")}
    if missing or not session.steps("backscatter"):
        raise SessionError(
            f"Expected flats, darks and panel pictures in the session {session.path}, found that "
            f"{' and '.join(sorted(missing)) or 'the pictures'} were not captured. Capture them with udccal check."
        )
    flat, dark = (session.average(session.step(f"wire/{name}").captures[0]) for name in ("flat", "dark"))
    gain, gain_sigma = gain_ratio(flat, dark, profile.noise, profile.rig.camera.cfa)
    pose = pose_change(profile.wire.term, read_wire(session, profile.noise.term, profile.wire.term.geometry))
    cause = explained(pose.values, pose.cov + _own_cov(profile), limits.chance)
    level = _level(profile, session, cause) / gain
    solved = Solved(pose, cause, level, gain)
    changes = (
        *_pose_changes(profile, cause, limits),
        _smudge(profile, pose, limits),
        _panel(profile, level, limits),
        _gain(gain, gain_sigma, limits),
    )
    return _answer(profile, changes, solved, limits), solved


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
    stated = {one.name: one.value for one in profile.backscatter.diagnostics}
    return brightness(SeenLight.of(data, term, stated.get("model_error_of_white", 0.0)))


def _pose_changes(profile: Profile, cause: Explained, limits: DriftLimits) -> Iterator[Change]:
    pitch, wire = profile.rig.panel.pitch_mm.value, profile.wire.term
    away = -float(wire.standoff_per_pitch)
    by_mm = pitch * np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [away, 0.0, 0.0]])
    update = "Go on with a profile that --update writes, or calibrate the rig again."
    focus = "Set the focus back, or calibrate the rig again: the psf changes with it."
    parts = (
        ("moved", "The camera moved by", by_mm, "mm", limits.moved_mm, update),
        ("tilted", "The camera turned by", np.rad2deg(np.eye(3)), "deg", limits.turned_deg, update),
        ("refocused", "The focal length changed by", np.array([[100.0]]), "%", limits.focus_percent, focus),
    )
    for name, said, unit_of, unit, limit, advice in parts:
        at = np.array(CAUSES[name])
        values, cov = unit_of @ cause.values[at], unit_of @ cause.cov[np.ix_(at, at)] @ unit_of.T
        size = float(np.linalg.norm(values))
        # Without a direction, the worst of all.
        variance = values @ cov @ values / size**2 if size > 0 else np.linalg.eigvalsh(cov)[-1]
        sigma = float(np.sqrt(max(float(variance), 0.0)))
        found = name in cause.causes
        told = f"{size:.4f} ± {sigma:.4f} {unit}" if found else f"less than {3 * sigma:.2g} {unit}"
        what = f"{said} {told}."
        yield Change(name, size, sigma, limit, unit, found, what, advice)


def _smudge(profile: Profile, pose: PoseChange, limits: DriftLimits) -> Change:
    stated = {one.name: one.value / 100 for one in profile.wire.diagnostics}.get("wire_map_rms_sigma", 0.0)
    sigma = np.hypot(pose.sigma, stated)
    row, column = np.unravel_index(int(np.nanargmax(np.abs(pose.left) / sigma)), CELLS)
    value, error = 100 * float(pose.left[row, column]), 100 * float(sigma[row, column])
    # The worst of many parts: Bonferroni's correction.
    least = -float(ndtri(limits.chance / (2 * pose.left.size)))
    camera = profile.rig.camera
    x, y = (column + 0.5) / CELLS[1] * camera.columns, (row + 0.5) / CELLS[0] * camera.rows
    place = f"at column {x:.0f}, row {y:.0f}"
    return Change(
        "smudge",
        abs(value),
        error,
        limits.smudge_percent,
        "%",
        abs(value) > least * error,
        f"What changed most of the picture, {place}, is {abs(value):.2f} % {'darker' if value < 0 else 'brighter'}.",
        f"Clean panel and lens {place}, and check again.",
    )


def _panel(profile: Profile, level: Float[np.ndarray, "3"], limits: DriftLimits) -> Change:
    stated = {one.name: one.value for one in profile.backscatter.diagnostics}
    # What the model leaves of single pictures is more than what it leaves of the whole panel's level.
    sigma = 100 * max(stated.get("held_out_without_noise_of_peak", 0.0), 1e-3)
    worst = int(np.argmax(np.abs(level - 1)))
    off = 100 * abs(float(level[worst]) - 1)
    return Change(
        "panel level",
        off,
        sigma,
        limits.panel_percent,
        "%",
        off > limits.errors * sigma,
        f"The panel is {100 * float(level[worst]):.1f} % as bright as at calibration "
        f"({('red', 'green', 'blue')[worst]}).",
        "Set the panel's brightness back, or go on with a profile that --update writes.",
    )


def _gain(gain: float, sigma: float, limits: DriftLimits) -> Change:
    off = 100 * abs(gain - 1)
    return Change(
        "gain",
        off,
        100 * sigma,
        limits.gain_percent,
        "%",
        off > limits.errors * 100 * sigma,
        f"The sensor's gain is {gain:.4f} times that of the profile.",
        "Set the camera's gain back, or go on with a profile that --update writes.",
    )


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
