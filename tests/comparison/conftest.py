"""The shipped profile, and a toy one whose maps are quick to make."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.profiles import conftest as profiles
from udccal.fitting.geometry.bundle import INTRINSIC_NAMES
from udccal.fitting.nominal import absent_backscatter, absent_psf, absent_wire, nominal_geometry
from udccal.models.noise import Noise
from udccal.mounting import angles_deg
from udccal.profiles.profile import Profile, build_profile
from udccal.profiles.provenance import provenance_now
from udccal.profiles.store import load_profile
from udccal.result import Estimate
from udccal.rig import load_rig
from udccal.sessions.schema import StoredCamera

_GEOMETRY_SIGMA = [0.03] * 4 + [1e-4, 7e-4, 1e-5, 1e-5, 1e-3] + [2e-3] * 3


def of_own_captures(profile: Profile) -> Profile:
    """The profile as if its captures were not known: what is made of it then counts as independent of it."""
    return replace(profile, **{one.name: replace(one, captures=None, effort=None) for one in profile.results})


@pytest.fixture(scope="session")
def measured() -> Profile:
    """A whole rig as measured."""
    return of_own_captures(load_profile("lg55-reduced"))


@pytest.fixture(scope="session")
def toy() -> Profile:
    """A tiny sensor with estimates of noise and geometry; its other terms have none."""
    rig = load_rig("lg55-reduced")
    rig = rig.model_copy(
        update={
            "camera": rig.camera.model_copy(update={"columns": 96, "rows": 64, "pitch_um": 69.0}),
            "view": rig.view.model_copy(update={"columns": 64, "rows": 36}),
        }
    )
    geometry = nominal_geometry(rig)
    lens = np.concatenate([geometry.focal_px, geometry.principal_point_px, geometry.distortion])
    numbers = np.concatenate([lens, angles_deg(geometry.rotation_rad)])
    names = (*INTRINSIC_NAMES, "tilt_deg", "roll_deg", "yaw_deg")
    units = ["px"] * 4 + ["1"] * 5 + ["deg"] * 3
    noise = Noise(*(np.float64(v) for v in (0.355, 64.1, 3969.0, 4.7, 0.08, 0.2, 1.0, 12.0, 2.0, 0.005)))
    light, wire = absent_backscatter(rig, geometry), absent_wire(rig, geometry)
    x = np.arange(rig.camera.columns)
    whole = build_profile(
        rig,
        provenance_now(None, StoredCamera(vendor="Basler", model="acA2040", serial="1", backend="simulated")),
        noise=profiles.fitted(
            "noise", noise, (Estimate("K_DN_per_e", 0.355, 1e-3, "DN/e"), Estimate("black_DN", 64.1, 0.1, "DN"))
        ),
        geometry=profiles.fitted("geometry", geometry, tuple(map(Estimate, names, numbers, _GEOMETRY_SIGMA, units))),
        wire=profiles.fitted("wire", wire),
        psf=profiles.fitted("psf", absent_psf(rig, geometry)),
        backscatter=profiles.fitted("backscatter", replace(light, mask=np.full(np.shape(light.mask), 2e4), window=5)),
        wire_map=np.tile(1 + 0.01 * np.sin(x), (rig.camera.rows, 1)),
    )
    return of_own_captures(whole)
