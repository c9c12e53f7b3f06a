"""Captures that a check cannot compare are refused with a sentence."""

from __future__ import annotations

from unittest.mock import create_autospec

import numpy as np
import pytest

from udccal.drift import check
from udccal.drift.gain import GainRatio
from udccal.drift.pose import PoseChange
from udccal.errors import SessionError
from udccal.fitting.backscatter.data import BackscatterData, Binned
from udccal.profiles.profile import Profile
from udccal.profiles.store import load_profile
from udccal.sessions.store import Session
from udccal.validation.flats import CELLS


@pytest.fixture(scope="module")
def profile() -> Profile:
    return load_profile("lg55-reduced")


def session_of(profile: Profile, left: float, monkeypatch: pytest.MonkeyPatch) -> Session:
    """A session whose flats leave this at the profile's pose."""
    pose = PoseChange(np.zeros(7), np.eye(7) * 1e-8, profile.wire.term, np.full(CELLS, left), np.full(CELLS, 1e-3), 1.0)
    monkeypatch.setattr(check, "read_wire", lambda *_: None)
    monkeypatch.setattr(check, "unusable_flat", lambda *_: None)
    monkeypatch.setattr(check, "gain_ratio", lambda *_: GainRatio(1.0, 1e-3))
    monkeypatch.setattr(check, "pose_change", lambda *_: pose)
    return create_autospec(Session, instance=True, rig=profile.rig, camera=profile.provenance.camera)


def test_a_sensor_with_too_few_pixels_is_refused(profile: Profile, monkeypatch: pytest.MonkeyPatch) -> None:
    """No part of it has a median, so that a smudge could not be looked for."""
    with pytest.raises(SessionError, match="No part of the sensor has enough pixels"):
        check.check_rig(profile, session_of(profile, np.nan, monkeypatch))


def test_pictures_that_tell_no_level_are_refused(profile: Profile, monkeypatch: pytest.MonkeyPatch) -> None:
    """The panel would else be as bright as at calibration."""
    session = session_of(profile, 0.0, monkeypatch)
    seen = np.ones((3, *np.shape(profile.backscatter.term.mask)))
    shots = Binned(seen, seen, seen, seen > 0, np.ones(3), np.ones(3))
    data = create_autospec(BackscatterData, instance=True, shots=shots)
    monkeypatch.setattr(check, "read_backscatter", lambda *_: data)
    with pytest.raises(SessionError, match=r"All of the panel's pictures are clipped"):
        check.check_rig(profile, session)
