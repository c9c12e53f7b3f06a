"""Profiles made of others: with other estimates, and of a camera that was moved."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from udccal.mounting import angles_deg
from udccal.profiles.profile import Profile
from udccal.result import FitResult
from udccal.sessions.schema import TermName


def with_result(profile: Profile, name: TermName, /, **changes: Any) -> Profile:
    """The profile with a term's result changed."""
    return replace(profile, **{name: replace(profile.result(name), **changes)})


def with_estimates(profile: Profile, term: TermName, added: Mapping[str, float]) -> Profile:
    """The profile with these numbers added to the estimates of a term; the term itself stays."""
    estimates = profile.result(term).estimates
    return with_result(
        profile, term, estimates=tuple(replace(one, value=one.value + added.get(one.name, 0.0)) for one in estimates)
    )


def moved(profile: Profile, by_mm: tuple[float, float, float], angles: tuple[float, float, float]) -> Profile:
    """The profile of a camera moved in the panel's frame, its tilt, roll and yaw changed in degrees: all but maps.

    Terms and estimates change; the wire's stored map does not.
    """
    x, y, z = np.array(by_mm) / profile.rig.panel.pitch_mm.value
    tilt, roll, yaw = angles_deg(np.asarray(profile.geometry.term.rotation_rad)) + angles
    turned = Rotation.from_euler("YXZ", [yaw, -tilt, roll], degrees=True).as_rotvec()
    geometry = replace(profile.geometry.term, rotation_rad=turned)
    profile = with_estimates(profile, "geometry", dict(zip(("tilt_deg", "roll_deg", "yaw_deg"), angles, strict=True)))
    profile = with_result(profile, "geometry", term=geometry)
    wire, light = profile.wire.term, profile.backscatter.term
    profile = with_estimates(profile, "wire", {"standoff_per_pitch": -z, "offset_x_periods": x, "offset_y_periods": y})
    profile = with_result(
        profile,
        "wire",
        term=replace(
            wire,
            geometry=geometry,
            standoff_per_pitch=wire.standoff_per_pitch - z,
            offset_periods=wire.offset_periods + np.array([x, y]),
        ),
    )
    profile = with_estimates(profile, "backscatter", {"standoff_mm": -by_mm[2], "offset_x_px": -x, "offset_y_px": -y})
    profile = with_result(
        profile,
        "backscatter",
        term=replace(
            light,
            geometry=geometry,
            standoff_mm=light.standoff_mm - by_mm[2],
            emitters_px=light.emitters_px - np.array([x, y]),
        ),
    )
    return with_result(profile, "psf", term=replace(profile.psf.term, geometry=geometry))


def at_roll(profile: Profile, roll_deg: float) -> Profile:
    """The profile of a camera that stands on its head."""
    tilt, _, yaw = angles_deg(np.asarray(profile.geometry.term.rotation_rad))
    turned = Rotation.from_euler("YXZ", [yaw, -tilt, roll_deg], degrees=True).as_rotvec()
    geometry = replace(profile.geometry.term, rotation_rad=turned)
    before = profile.geometry.estimate("roll_deg").value
    profile = with_estimates(profile, "geometry", {"roll_deg": roll_deg - before})
    profile = with_result(profile, "geometry", term=geometry)
    return with_result(profile, "wire", term=replace(profile.wire.term, geometry=geometry))


def drawn(profile: Profile, rng: np.random.Generator, terms: tuple[TermName, ...]) -> Profile:
    """The profile with the estimates of some terms drawn anew from their own covariances."""
    for term in terms:
        result: FitResult = profile.result(term)
        noise = rng.multivariate_normal(np.zeros(len(result.cov)), result.cov, method="eigh")
        names = [one.name for one in result.estimates[: len(result.cov)]]
        profile = with_estimates(profile, term, dict(zip(names, noise, strict=True)))
    return profile
