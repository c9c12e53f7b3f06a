"""The camera's place in files for other programs: the rig's state, or what stands for it, said."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from udccal.comparison.place import place_of
from udccal.comparison.rig_state import rig_state
from udccal.mounting import nominal_pupil_mm
from udccal.profiles.exchange.exports import EXPORTS, covariance_file, export_profile
from udccal.profiles.exchange.imports import IMPORTS, read_lens
from udccal.profiles.profile import Profile


def test_a_measured_place_is_that_of_the_rigs_state(measured: Profile, tmp_path: Path) -> None:
    """The geometry term has the rig file's place, since boards do not tell where the panel is."""
    place, known = place_of(measured), {one.name: one for one in rig_state(measured).estimates}
    pitch = known["pitch_mm"].value
    wanted = [known["panel_x_px"].value * pitch, known["panel_y_px"].value * pitch, -known["standoff_mm"].value]
    assert place.pupil_mm == pytest.approx(wanted)
    assert np.abs(place.pupil_mm - nominal_pupil_mm(measured.rig))[:2].max() > 0.1
    assert place.cov_mm2 is not None
    assert np.sqrt(place.cov_mm2[2, 2]) == pytest.approx(known["standoff_mm"].sigma)
    # Of a metre of panel, the pitch's tolerance is more than what the emitters tell.
    assert np.sqrt(place.cov_mm2[0, 0]) > known["panel_x_px"].sigma * pitch
    assert "The camera's place is measured" in place.what
    for name in ("opencv-yaml", "mrcal", "ros-camera-info"):
        export_profile(measured, EXPORTS[name], tmp_path / name, place)
    lens = read_lens(tmp_path / "opencv-yaml", IMPORTS["opencv-yaml"])
    assert lens.pose is not None
    np.testing.assert_array_equal(lens.pose.pupil_mm, place.pupil_mm)
    for name in ("opencv-yaml", "mrcal"):
        stored = json.loads(covariance_file(tmp_path / name).read_text())["place"]
        assert stored["what"] == place.what
        assert stored["pupil_mm"] == place.pupil_mm.tolist()
        assert stored["sigma_mm"][2] == pytest.approx(known["standoff_mm"].sigma)
    assert json.loads(covariance_file(tmp_path / "ros-camera-info").read_text())["place"] is None
    assert "'extrinsics'" in (tmp_path / "mrcal").read_text()


def test_a_place_that_nobody_measured_is_told(toy: Profile) -> None:
    place = place_of(toy)
    assert place.what == "The camera's place is the rig file's nominal one, which no term has measured."
    np.testing.assert_array_equal(place.pupil_mm, np.asarray(toy.geometry.term.pupil_mm))
    assert place.cov_mm2 is None
    term = replace(toy.geometry.term, pupil_mm=np.array([600.0, 190.0, -15.0]))
    other = place_of(replace(toy, geometry=replace(toy.geometry, term=term)))
    assert (other.what, other.pupil_mm[2]) == ("The camera's place is the imported one.", -15.0)
