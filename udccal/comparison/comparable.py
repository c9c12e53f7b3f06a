"""Which profiles and sessions may be compared: those of one rig with one sensor, with finite numbers."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from udccal.errors import ProfileError, SessionError
from udccal.profiles.profile import Profile
from udccal.profiles.store import check_profile
from udccal.rig import RigDescription
from udccal.sessions.schema import StoredCamera
from udccal.sessions.store import Session


def check_comparable(a: Profile, b: Profile) -> None:
    """Refuse two profiles that do not describe one rig.

    Raises:
        ProfileError: when rig, panel, sensor or camera differ; the message names the first difference.
    """
    for profile in (a, b):
        check_profile(profile)
    if (found := _difference(a.rig, a.provenance.camera, b.rig, b.provenance.camera)) is not None:
        what, first, second = found
        raise ProfileError(
            f"Expected two profiles of one rig, found another {what}: {first} in A, {second} in B. "
            "Compare profiles of the same rig and camera."
        )


def check_same_rig(profile: Profile, rig: RigDescription, taken_by: StoredCamera) -> None:
    """Refuse a profile that does not describe the rig and the camera of captures.

    Raises:
        ProfileError: when rig, panel, sensor or camera differ; the message names the first difference.
    """
    if (found := _difference(profile.rig, profile.provenance.camera, rig, taken_by)) is not None:
        what, first, second = found
        raise ProfileError(
            f"Expected captures of the profile's rig, found another {what}: {second}, and {first} in the profile. "
            "Use the same rig and camera."
        )


def check_sessions(a: Session, b: Session) -> None:
    """Refuse two sessions that are not of one rig and camera.

    Raises:
        SessionError: when rig, panel, sensor or camera differ; the message names the first difference.
    """
    if (found := _difference(a.rig, a.camera, b.rig, b.camera)) is not None:
        what, first, second = found
        raise SessionError(
            f"Expected two sessions of one rig, found another {what}: {first} in {a.path}, {second} in {b.path}. "
            "Compare sessions of the same rig and camera."
        )


def _difference(
    a: RigDescription, camera_a: StoredCamera | None, b: RigDescription, camera_b: StoredCamera | None
) -> tuple[str, object, object] | None:
    """The first thing that differs, in A and in B."""
    for (what, first), (_, second) in zip(_identity(a, camera_a), _identity(b, camera_b), strict=True):
        if first != second and None not in (first, second):
            return what, first, second
    return None


def check_finite(*numbers: Float[np.ndarray, "..."]) -> None:
    """Refuse numbers that were computed of a profile and cannot be compared.

    Raises:
        ProfileError: when one is not finite.
    """
    if not all(np.isfinite(some).all() for some in numbers):
        raise ProfileError(
            "Expected terms and error bars that give finite numbers, found others. Restore both profiles from copies, "
            "or calibrate the rig again."
        )


def _identity(rig: RigDescription, taken_by: StoredCamera | None) -> Iterator[tuple[str, object]]:
    """What must agree. Lengths of the mounting are among it because places count from the nominal one."""
    yield "rig", rig.name
    yield "panel", rig.panel.model
    yield "size of the panel in pixels", (rig.panel.columns, rig.panel.rows)
    yield "nominal pitch of the panel in mm", rig.panel.pitch_mm.value
    yield "size of the sensor in pixels", (rig.camera.columns, rig.camera.rows)
    yield "pitch of the sensor in µm", rig.camera.pitch_um
    yield "pattern of colours", rig.camera.cfa
    yield "number of bits", rig.camera.bits
    yield "nominal place on the panel", (rig.mounting.panel_x_px.value, rig.mounting.panel_y_px.value)
    yield "camera", None if taken_by is None else f"{taken_by.model}, serial {taken_by.serial}"
