"""Restoration of one frame in one call."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import UInt8, UInt16

from udccal.profiles.profile import Profile
from udccal.profiles.store import load_profile
from udccal.restoration.checks import check_frame, check_panel_picture
from udccal.restoration.runtime import Picture, Restorer
from udccal.tiers import Tier


def restore(
    mosaic: UInt16[np.ndarray, "frame_rows frame_columns"],
    exposure_s: float,
    profile: Profile | str | Path,
    panel_picture: UInt8[np.ndarray, "panel_rows panel_columns 3"] | None = None,
    tier: Tier | str = Tier.balanced,
) -> Picture:
    """Restore one frame. Most of the time goes into preparing the profile: for several frames, keep a ``Restorer``.

    Args:
        mosaic: raw frame in DN, of the size of the rig's sensor.
        exposure_s: exposure time of the frame in s.
        profile: the rig as measured; or a profile's path, or the name of a rig that has one.
        panel_picture: what the panel showed, 8-bit RGB (a black picture when it was off); None when not known.
        tier: how much is done to the frame; preview, fast, balanced or accurate.

    Returns:
        the clean picture on the virtual view: (rows, columns, 3), linear RGB in e-/s.

    Raises:
        ProfileError: when the profile cannot be read.
        RestorationError: as ``Restorer.from_profile`` and ``Restorer.restore``.
    """
    found = profile if isinstance(profile, Profile) else load_profile(profile)
    check_frame(mosaic, exposure_s, found.rig)
    check_panel_picture(panel_picture, found.rig)
    return Restorer.from_profile(found, tier).restore(mosaic, exposure_s, panel_picture)
