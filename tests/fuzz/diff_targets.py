"""Comparisons of a whole profile with one whose numbers were changed."""

from __future__ import annotations

import functools
import math
from unittest import mock

import numpy as np

from tests.fuzz.profile_targets import _changed, _seeds, _whole
from tests.fuzz.target import Target
from udccal.comparison import maps
from udccal.comparison.diff import ProfileDiff, compare
from udccal.comparison.limits import DiffLimits
from udccal.profiles.profile import Profile
from udccal.profiles.provenance import PROFILE_NAME
from udccal.profiles.store import read_profile


@functools.cache
def _original() -> Profile:
    return _read(_whole().text.encode())


def _read(data: bytes) -> Profile:
    folder = _whole().folder
    (folder / PROFILE_NAME).write_bytes(data)
    return read_profile(folder)


def _kernels(a: Profile, b: Profile, same: bool) -> tuple[np.ndarray, np.ndarray]:
    """Points: kernels of other sizes would be compiled for a minute."""
    point = np.zeros((4, 3, 3, 3))
    point[..., 1, 1] = 1.0
    return point, point


def _diff(data: bytes) -> None:
    original = _original()
    changed = _read(_changed(data))
    with mock.patch.object(maps, "_kernels", _kernels):
        found: ProfileDiff = compare(original, changed, DiffLimits())[0]
    assert all(math.isfinite(e.value) for term in found.terms for e in term.effects), "expected finite effects"


# A change of a size is compiled anew, which takes seconds.
DIFF_TARGETS = (Target("diff", _diff, _seeds, 64, one_in=20, longest_s=40.0),)
