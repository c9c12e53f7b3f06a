"""Which profiles may be compared: those of one rig with one sensor, with finite numbers."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from udccal.errors import ProfileError
from udccal.profiles.profile import Profile


def check_comparable(a: Profile, b: Profile) -> None:
    """Refuse two profiles that do not describe one rig.

    Raises:
        ProfileError: when rig, panel, sensor or camera differ; the message names the first difference.
    """
    for (what, first), (_, second) in zip(_identity(a), _identity(b), strict=True):
        if first != second and None not in (first, second):
            raise ProfileError(
                f"Expected two profiles of one rig, found another {what}: {first} in A, {second} in B. "
                "Compare profiles of the same rig and camera."
            )


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


def _identity(profile: Profile) -> Iterator[tuple[str, object]]:
    """What must agree. Lengths of the mounting are among it because places count from the nominal one."""
    rig, taken_by = profile.rig, profile.provenance.camera
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
