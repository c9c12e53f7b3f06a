"""A profile with what a check has found, against the old one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from udccal.comparison.estimates import difference
from udccal.comparison.held import held_estimates
from udccal.comparison.limits import DiffLimits
from udccal.comparison.movement import movement
from udccal.drift.causes import Explained
from udccal.drift.changes import Change
from udccal.drift.check import FORMAT, VERSION, RigCheck, Solved
from udccal.drift.limits import DriftLimits
from udccal.drift.pose import PoseChange
from udccal.drift.update import updated
from udccal.fitting.wire.fit import sensor_map
from udccal.profiles.profile import Profile
from udccal.profiles.provenance import profile_sha256
from udccal.profiles.store import find_profile, load_profile, read_profile, write_profile
from udccal.sessions.manifest import MANIFEST_NAME

pytestmark = pytest.mark.medium
MOVED_MM, TURNED_RAD = np.array([0.05, -0.03, 0.02]), np.deg2rad(0.1)


@pytest.fixture(scope="module")
def profile() -> Profile:
    return load_profile("lg55-reduced")


def checked(profile: Profile, names: tuple[str, ...]) -> tuple[RigCheck, Solved]:
    """A check that found these changes."""
    wire, pitch = profile.wire.term, profile.rig.panel.pitch_mm.value
    x, y, z = MOVED_MM / pitch
    values = np.array([TURNED_RAD, 0.0, 0.0, np.log1p(-z / float(wire.standoff_per_pitch)), x, y, 0.0])
    values[:3] *= "tilted" in names
    values[3:6] *= "moved" in names
    values[6] = 0.01 * ("refocused" in names)
    cov = np.diag(np.full(7, 1e-6))
    pose = PoseChange(values, cov, wire, np.zeros((24, 32)), np.ones((24, 32)), 1.0)
    changes = tuple(Change(name, 1.0, 0.1, 0.5, "1", True, "It changed.", "Mend it.") for name in names)
    found = RigCheck(FORMAT, VERSION, "x", "changed", names, "Mend it.", changes, (0.0, 0.0, 0.0), 1.0, DriftLimits())
    return found, Solved(pose, Explained(names, values, cov), np.full(3, 0.9), 1.02)


@pytest.fixture
def session(tmp_path: Path) -> Path:
    (tmp_path / MANIFEST_NAME).write_text("{}", encoding="utf-8")
    return tmp_path


def test_the_movement_found_is_the_difference_of_the_profiles(profile: Profile, session: Path) -> None:
    new = updated(profile, Path("lg55-reduced"), *checked(profile, ("moved", "tilted")), session)
    found = movement(
        difference(held_estimates(profile), held_estimates(new)), profile.rig.panel.pitch_mm.value, DiffLimits()
    )
    parts = {part.name: part.value for part in found.parts}
    assert [parts[axis] for axis in "xyz"] == pytest.approx(MOVED_MM, abs=1e-4)
    assert found.angle.value == pytest.approx(0.1, abs=2e-3)
    assert found.agreement_p_value > 0.1
    camera = profile.rig.camera
    assert new.wire_map == pytest.approx(sensor_map(new.wire.term, camera.rows, camera.columns), rel=1e-5)


def test_only_what_changed_is_replaced_and_the_parent_is_named(profile: Profile, session: Path) -> None:
    new = updated(profile, Path("lg55-reduced"), *checked(profile, ("gain", "panel level")), session)
    assert new.parent == profile_sha256(find_profile("lg55-reduced"))
    assert float(new.noise.term.K_DN_per_e) == pytest.approx(1.02 * float(profile.noise.term.K_DN_per_e))
    assert new.noise.estimate("K_DN_per_e").value == pytest.approx(float(new.noise.term.K_DN_per_e))
    assert new.backscatter.term.mask == pytest.approx(0.9 * np.asarray(profile.backscatter.term.mask))
    assert np.array_equal(new.wire_map, profile.wire_map)
    assert new.geometry.estimates == profile.geometry.estimates


def test_an_updated_profile_is_written_and_read(profile: Profile, session: Path, tmp_path: Path) -> None:
    write_profile(tmp_path / "old.zip", profile)
    new = updated(profile, tmp_path / "old.zip", *checked(profile, ("moved",)), session)
    write_profile(tmp_path / "new", new)
    read = read_profile(tmp_path / "new")
    assert read.parent == new.parent
    assert "by a check" in read.wire.notes[-1]
    assert replace(read.noise, posterior=None).estimates == profile.noise.estimates


def test_what_a_check_changed_is_no_fit_of_the_old_captures(profile: Profile, session: Path) -> None:
    """A comparison would else say that both profiles were fitted to the same captures, and tell no movement."""
    assert all(result.captures for result in profile.results)
    moved = updated(profile, Path("lg55-reduced"), *checked(profile, ("moved",)), session)
    kept = [one.name for one in moved.results if one.captures]
    assert kept == ["noise", "geometry"]
    brighter = updated(profile, Path("lg55-reduced"), *checked(profile, ("gain", "panel level")), session)
    assert [one.name for one in brighter.results if one.captures] == ["geometry", "wire", "psf"]


def test_the_gain_has_the_error_of_the_check(profile: Profile, session: Path) -> None:
    new = updated(profile, Path("lg55-reduced"), *checked(profile, ("gain",)), session)
    K = new.noise.estimate("K_DN_per_e")
    assert K.sigma == pytest.approx(0.001 * float(profile.noise.term.K_DN_per_e))  # 0.1 % in ``checked``
    assert new.noise.cov[0, 0] == pytest.approx(K.sigma**2)


def test_a_profile_without_a_pose_of_its_geometry_is_updated_too(profile: Profile, session: Path) -> None:
    without = replace(profile, geometry=replace(profile.geometry, estimates=(), cov=np.zeros((0, 0))))
    new = updated(without, Path("lg55-reduced"), *checked(without, ("tilted",)), session)
    assert new.geometry.estimates == ()
    assert np.abs(np.asarray(new.geometry.term.rotation_rad) - np.asarray(profile.geometry.term.rotation_rad)).max() > 0


def test_the_place_keeps_the_checks_correlations(profile: Profile, session: Path) -> None:
    found, solved = checked(profile, ("moved",))
    cov = solved.cause.cov.copy()
    cov[3, 4] = cov[4, 3] = 0.8e-6
    # With all seven numbers free, that of a place is larger: focus and turn look alike.
    solved = replace(solved, cause=replace(solved.cause, cov=cov), pose=replace(solved.pose, cov=300 * cov))
    wire = updated(profile, Path("lg55-reduced"), found, solved, session).wire
    i, j = ([one.name for one in wire.estimates].index(name) for name in ("standoff_per_pitch", "offset_x_periods"))
    sigma = np.sqrt(np.diag(wire.cov))
    assert sigma[j] == pytest.approx(1e-3)
    assert wire.cov[i, j] / sigma[i] / sigma[j] == pytest.approx(0.8)
    assert (wire.estimates[i].sigma, wire.estimates[j].sigma) == pytest.approx((sigma[i], sigma[j]))
    assert np.linalg.eigvalsh(wire.cov / np.outer(sigma, sigma)).min() > -1e-9


def test_a_new_focal_length_has_the_errors_of_both(profile: Profile, session: Path) -> None:
    new = updated(profile, Path("lg55-reduced"), *checked(profile, ("refocused",)), session).geometry
    old = profile.geometry
    names = [one.name for one in old.estimates]
    for axis, name in enumerate(("fx", "fy")):
        i, before, after = names.index(name), old.estimate(name), new.estimate(name)
        assert after.value == pytest.approx(before.value * np.exp(0.01))
        assert after.value == pytest.approx(float(new.term.focal_px[axis]))
        assert after.sigma == pytest.approx(np.hypot(before.sigma, 1e-3 * after.value))
        assert new.cov[i, i] == pytest.approx(after.sigma**2)
    i, j, k = (names.index(name) for name in ("fx", "fy", "k1"))
    assert new.cov[i, j] / np.sqrt(new.cov[i, i] * new.cov[j, j]) > 0.99
    assert new.cov[i, k] == old.cov[i, k]


def test_the_light_has_the_error_of_the_movement_too(profile: Profile, session: Path) -> None:
    new = updated(profile, Path("lg55-reduced"), *checked(profile, ("moved",)), session).backscatter
    before, after = profile.backscatter.estimate("offset_x_px"), new.estimate("offset_x_px")
    assert after.value == pytest.approx(before.value - MOVED_MM[0] / profile.rig.panel.pitch_mm.value)
    assert after.sigma == pytest.approx(np.hypot(before.sigma, 1e-3))


@pytest.mark.parametrize(
    ("causes", "noted"),
    [
        (("panel level",), {"backscatter": "(panel level 90.0, 90.0, 90.0 %): its numbers are older."}),
        (("gain",), {"noise": "(gain): it found K_DN_per_e, the other numbers are older."}),
        (
            ("moved",),
            {
                "wire": "(moved): it found standoff_per_pitch, offset_x_periods, offset_y_periods, the other",
                "psf": "(moved): its numbers are older.",
                "backscatter": "(moved): it found standoff_mm, offset_x_px, offset_y_px, the other",
            },
        ),
        (
            ("refocused",),
            {
                "geometry": "(refocused): it found fx, fy, the other",
                "wire": "(refocused): its numbers are older.",
                "psf": "(refocused): its numbers are older. After a change of focus, the psf needs a calibration.",
                "backscatter": "(refocused): its numbers are older.",
            },
        ),
    ],
)
def test_every_term_that_changed_says_so(
    profile: Profile, session: Path, causes: tuple[str, ...], noted: dict[str, str]
) -> None:
    new = updated(profile, Path("lg55-reduced"), *checked(profile, causes), session)
    told = {one.name: one.notes[len(profile.result(one.name).notes) :] for one in new.results}
    assert {name for name, notes in told.items() if notes} == set(noted)
    for name, words in noted.items():
        assert f"Changed by a check of a few minutes {words}" in told[name][0]
