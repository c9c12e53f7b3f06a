"""A profile whose lens has every coefficient, and a camera that is turned about every axis."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from tests.profiles.conftest import fitted
from udccal.models.geometry import Geometry
from udccal.profiles.profile import Profile

# Fewer digits do not tell whether a file keeps all of them.
LENS = Geometry(
    focal_px=np.array([88.051363287, 88.035131088]) + 1 / 3e9,
    principal_point_px=np.array([46.147352984, 30.379376765]) + 1 / 3e9,
    distortion=np.array([-0.062509847, 0.022148053, -0.0035926272, -0.0015521283, -0.0046029138]) + 1 / 3e12,
    rotation_rad=np.array([-0.308101819, 0.04867141494, 0.01438605]),
    pupil_mm=np.array([604.8, 189.0, -14.0]),
)


@pytest.fixture(scope="session")
def profile(toy_profile: Profile) -> Profile:
    return dataclasses.replace(toy_profile, geometry=fitted("geometry", LENS))


@pytest.fixture(scope="session")
def points() -> np.ndarray:
    """Points before the camera whose pictures lie all over the sensor, and a little beyond."""
    x, y = np.meshgrid(np.linspace(-0.6, 0.6, 9), np.linspace(-0.4, 0.4, 7))
    depth = np.random.default_rng(1).uniform(0.5, 40.0, x.size)
    return depth[:, None] * np.column_stack([x.ravel(), y.ravel(), np.ones(x.size)])
