"""The light of drawn rigs against sums over points, their program's independence, and a judge that rejects."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.benchmarks.drawn_rigs import diffraction
from tests.benchmarks.drawn_rigs.__main__ import rows_of, table
from tests.benchmarks.drawn_rigs.draw import Shape, draw
from tests.benchmarks.drawn_rigs.judge import Judged, judge
from tests.benchmarks.drawn_rigs.one import Finished
from tests.benchmarks.drawn_rigs.openings import area_below, openings
from tests.benchmarks.drawn_rigs.optics import directions, footprint
from tests.benchmarks.drawn_rigs.sensor import DrawnSensor
from tests.benchmarks.drawn_rigs.session import require_own, write_session
from tests.benchmarks.drawn_rigs.wire import open_part
from udccal.calibration import calibrate
from udccal.profiles.store import read_profile
from udccal.sessions.store import Session

ROOT = Path(__file__).resolve().parents[3]
SHAPE = Shape("all of these", 0.8, 0.5, (0.05, 0.08), 0.1, 0.03, 0.03, 0.05, True, (0.1, -0.1))
SHAPES = [SHAPE, replace(SHAPE, upright=False), replace(SHAPE, corner=0.0, slant=0.0, trace=0.0)]


def passes(shape: Shape, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Whether a point of the period is open at one depth of the structure."""
    half = shape.height / 2
    wide = shape.width / 2 + shape.slant / 2 * y / half
    if shape.corner:
        into = np.clip((np.abs(y) - (half - shape.corner)) / shape.corner, 0, 1)
        wide = wide - shape.corner * (1 - np.sqrt(1 - into**2))
    on_line = np.abs((x if shape.upright else y) - shape.trace_at) < shape.trace / 2
    return (np.abs(y) < half) & (np.abs(x) < wide) & ~on_line


def open_at(shape: Shape, x: np.ndarray, y: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """Whether a ray that crosses the panel at (x, y), in periods, passes all depths of the structure."""
    x, y = (v - np.round(v) for v in (x, y))
    steps = np.linspace(0, 1, 9)[:, None]
    return passes(shape, x + steps * shape.depth[0] * slope[0], y + steps * shape.depth[1] * slope[1]).all(axis=0)


@pytest.mark.parametrize("shape", SHAPES)
def test_series_and_areas_are_those_of_the_openings(shape: Shape) -> None:
    opened, slope = openings(shape, (0.4, -0.3)), np.array([0.4, -0.3])
    rng = np.random.default_rng(1)
    x, y = rng.uniform([[-0.3], [-0.2]], [[1.9], [2.1]], (2, 200_000))
    counted = 2.2 * 2.3 * open_at(shape, x, y, slope).mean()
    at = opened.table()
    corners = [
        area_below(at, np.array([x]), np.array([y]))[0] for x, y in ((1.9, 2.1), (-0.3, 2.1), (1.9, -0.2), (-0.3, -0.2))
    ]
    assert corners[0] - corners[1] - corners[2] + corners[3] == pytest.approx(counted, abs=0.02)
    assert opened.coefficients(3, 2)[3, 2].real == pytest.approx(at[-1, -1], abs=1e-9)


def test_the_wire_is_the_open_area_of_the_footprint() -> None:
    rig = draw(1000)
    rays = directions(rig, np.array([[30.0, 40.0], [310.5, 200.0], [600.0, 420.0]]))
    disc = np.random.default_rng(2).uniform(-1, 1, (100_000, 2))
    disc = disc[(disc**2).sum(axis=1) < 1]
    for ray, found in zip(rays, open_part(rig, rays), strict=True):
        centre, shape = footprint(rig, ray)
        x, y = ((centre + disc @ shape.T) / rig.true("pitch_mm") - rig.shape.offset).T
        assert found == pytest.approx(open_at(rig.shape, x, y, ray[:2] / ray[2]).mean(), abs=6e-3)


def test_kernels_are_even_and_keep_their_light() -> None:
    rig = draw(1000)
    kernel = diffraction.kernel(rig, rig.lens.centre_px, 41, 21)
    np.testing.assert_allclose(kernel, kernel[:, ::-1, ::-1], atol=2e-4)
    spread = diffraction.spread_of(rig, rig.lens.centre_px, (14.0, 24.0))
    middle = np.round(rig.lens.centre_px).astype(int)
    light = diffraction.light(
        rig, spread, rig.lens.centre_px, middle[0] + np.arange(-10, 11), middle[1] + np.arange(-20, 21)
    )
    assert ((light.sum(axis=(0, 1)) > 0.85) & (light.sum(axis=(0, 1)) < 1.0)).all()


def test_more_light_is_never_darker() -> None:
    rig = draw(1000)
    sensor = DrawnSensor(replace(rig, noise=replace(rig.noise, bend=0.02)))
    frames = [sensor.frame(np.full((rig.rows, rig.columns), light), 1.0).mean() for light in (1e2, 1e4, 1e6, 1e8)]
    assert (np.diff(frames) >= 0).all()


def test_the_program_knows_nothing_of_udccal() -> None:
    code = "import sys; from tests.benchmarks.drawn_rigs.session import require_own; require_own(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)
    with pytest.raises(RuntimeError, match=r"udccal\.models"):
        require_own(["numpy", "udccal.models.wire"])


def test_what_is_silently_wrong_is_missed() -> None:
    good = Judged("wire", 0.01, 0.05, "%", 0.001, "")
    off = replace(good, value=0.2)
    assert good.ok
    assert not off.ok
    assert not replace(good, value=float("nan"), said="POOR_FIT").ok
    assert not replace(off, stated=0.05).ok
    assert not replace(off, stated=float("nan")).ok
    assert replace(off, stated=0.11).ok
    assert replace(off, said="POOR_FIT").ok
    rig = Finished(0, "a rig", "abc", 1.0, (good, off))
    assert [row.ok for row in rows_of(rig)] == [True, False]
    assert "missed" in table([rig])


@pytest.mark.medium
def test_a_small_rig_is_fitted_and_judged(tmp_path: Path) -> None:
    rig = draw(1003, (240, 180))
    write_session(rig, tmp_path / "session", ("noise", "geometry", "wire", "backscatter"))
    calibrate(Session.open(tmp_path / "session")).write(tmp_path / "profile")
    profile = read_profile(tmp_path / "profile")
    assert all(one.ok for one in judge(profile, rig)), judge(profile, rig)
    # Another rig's truth: nearly nothing of it is kept, and the profile cannot know.
    other = judge(profile, draw(1004, (240, 180)))
    silent = {one.name for one in other if not one.ok}
    assert {"wire map, RMS", "K", "tilt"} <= silent, other
