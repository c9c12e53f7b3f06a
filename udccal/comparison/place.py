"""Where the camera's entrance pupil is in the panel's frame, for other programs: measured where a term tells it."""

from __future__ import annotations

import numpy as np

from udccal.comparison.rig_state import NAMES, rig_state
from udccal.mounting import nominal_pupil_mm
from udccal.profiles.exchange.format import Place
from udccal.profiles.profile import Profile

_TOLD = ("panel_x_px", "panel_y_px", "standoff_mm")


def place_of(profile: Profile) -> Place:
    """Return the place of the rig's state; the geometry term's, where no term tells any of it.

    The geometry term has the rig file's place, as boards do not tell where the panel is, or that of an imported file.

    Raises:
        ProfileError: as ``rig_state`` does.
    """
    state = rig_state(profile)
    known = dict(zip(NAMES, state.estimates, strict=True))
    nominal = [name for name in _TOLD if known[name].by_prior]
    if len(nominal) == len(_TOLD):
        held = np.asarray(profile.geometry.term.pupil_mm, dtype=np.float64)
        nobody = np.allclose(held, nominal_pupil_mm(profile.rig))
        whose = "the rig file's nominal one, which no term has measured" if nobody else "the imported one"
        return Place(held, None, f"The camera's place is {whose}.")
    x, y, away, pitch = (known[name].value for name in (*_TOLD, "pitch_mm"))
    change = np.zeros((3, len(NAMES)))
    for row, (name, derivative) in enumerate(zip(_TOLD, (pitch, pitch, -1.0), strict=True)):
        change[row, NAMES.index(name)] = derivative
    change[:2, NAMES.index("pitch_mm")] = x, y
    pupil, cov = np.array([x * pitch, y * pitch, -away]), change @ state.cov @ change.T
    spread = ", ".join(f"{one:.3f} ± {sigma:.3f}" for one, sigma in zip(pupil, np.sqrt(np.diag(cov)), strict=True))
    rest = f" Of it, {' and '.join(nominal)} are the rig file's." if nominal else ""
    return Place(pupil, cov, f"The camera's place is measured, as `profile show` has it: {spread} mm.{rest}")
