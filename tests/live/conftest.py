"""A tiny rig's profile, in which only the noise was measured, and pictures to send."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest

from tests.scenes.toy_restorer import fitted
from udccal.cameras.protocol import Frame, Region, Settings
from udccal.fitting.nominal import absent_backscatter, absent_psf, absent_wire, nominal_geometry
from udccal.fitting.wire.fit import sensor_map
from udccal.live.sinks.protocol import RestoredFrame
from udccal.models.noise import Noise
from udccal.profiles.profile import Profile, build_profile
from udccal.profiles.provenance import provenance_now
from udccal.profiles.store import write_profile
from udccal.result import FitStatus
from udccal.rig import RigDescription, load_rig

ROWS, COLUMNS = 36, 64
NOISE = Noise(0.355, 64.0, 3969.0, 5.0, 0.1, 0.2, 1.0, 20.0, 2.0, 0.005)


@pytest.fixture(scope="session")
def live_rig() -> RigDescription:
    rig = load_rig("lg55-reduced")
    camera = rig.camera.model_copy(update={"columns": 96, "rows": 64, "pitch_um": 69.0})
    panel = rig.panel.model_copy(update={"columns": 32, "rows": 24})
    view = rig.view.model_copy(update={"columns": COLUMNS, "rows": ROWS})
    return rig.model_copy(update={"camera": camera, "panel": panel, "view": view})


def profile_of(rig: RigDescription, noise: Noise = NOISE) -> Profile:
    geometry = nominal_geometry(rig)
    wire = absent_wire(rig, geometry)

    found = partial(fitted, status=FitStatus.ABSENT)
    return build_profile(
        rig,
        provenance_now(None, None),
        noise=fitted(noise),
        geometry=found(geometry),
        wire=found(wire),
        psf=found(absent_psf(rig, geometry)),
        backscatter=found(absent_backscatter(rig, geometry)),
        wire_map=sensor_map(wire, rig.camera.rows, rig.camera.columns),
    )


@pytest.fixture(scope="session")
def live_profile(live_rig: RigDescription) -> Profile:
    return profile_of(live_rig)


@pytest.fixture
def profile_folder(live_profile: Profile, tmp_path: Path) -> Path:
    write_profile(tmp_path / "profile", live_profile)
    return tmp_path / "profile"


def raw_frame(number: int, level: int = 1000, complete: bool = True) -> Frame:
    settings = Settings(1e-3, 0.0, Region(0, 0, 96, 64))
    return Frame(np.full((64, 96), level, np.uint16), settings, number / 30, number, complete)


def restored_frame(number: int, rows: int = ROWS, columns: int = COLUMNS, at_s: float | None = None) -> RestoredFrame:
    """All pixels of frame n are n modulo 251."""
    picture = np.full((rows, columns, 3), number % 251, np.uint8)
    return RestoredFrame(picture, number, round(1e9 * (number / 30 if at_s is None else at_s)))
