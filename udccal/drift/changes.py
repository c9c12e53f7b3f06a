"""Each possible change of a rig as a number with its sigma and limit, a sentence, and what to do."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float
from scipy.special import ndtri

from udccal.drift.causes import CAUSES, Explained
from udccal.drift.gain import GainRatio
from udccal.drift.limits import DriftLimits
from udccal.drift.pose import PoseChange
from udccal.profiles.profile import Profile
from udccal.validation.flats import CELLS


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


def pose_changes(profile: Profile, cause: Explained, limits: DriftLimits) -> Iterator[Change]:
    """Yield movement, turn and change of focus, found or not."""
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


def smudge(profile: Profile, pose: PoseChange, limits: DriftLimits) -> Change:
    """Return the change of the worst part of the sensor."""
    stated = (profile.wire.diagnostic("wire_map_rms_sigma") or 0.0) / 100
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


def panel_level(profile: Profile, level: Float[np.ndarray, "3"], gain_sigma: float, limits: DriftLimits) -> Change:
    """Return the change of the panel's brightness in the worst colour.

    ``level`` is over the profile's, after division by the gain, whose relative error it has.
    """
    # What the model leaves of single pictures is more than what it leaves of the whole panel's level.
    stated = max(profile.backscatter.diagnostic("held_out_without_noise_of_peak") or 0.0, 1e-3)
    sigma = 100 * float(np.hypot(stated, gain_sigma))
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


def gain_change(gain: GainRatio, limits: DriftLimits) -> Change:
    """Return the change of the sensor's gain; what flicker of the lamp makes of it is told."""
    off, sigma = 100 * abs(gain.value - 1), 100 * gain.sigma
    told = f"The sensor's gain is {gain.value:.4f} times that of the profile."
    if gain.flicker:
        told += (
            f" The lamp flickers by {100 * gain.flicker:.2f} % from frame to frame: {gain.raised:.4f} of that is its "
            "doing, not the gain's. Use a steady lamp."
        )
    return Change(
        "gain",
        off,
        sigma,
        limits.gain_percent,
        "%",
        off > limits.errors * sigma,
        told,
        "Set the camera's gain back, or go on with a profile that --update writes.",
    )
