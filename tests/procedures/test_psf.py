from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from procedures.base import run_procedure
from procedures.psf import PsfProcedure, led_positions_px, region_around
from tests.procedures.benches import new_writer, simulated_bench, small_rig
from tests.procedures.test_base import DarkStage
from udccal.errors import CaptureError
from udccal.rig import load_rig
from udccal.sessions.store import Session


@pytest.mark.parametrize("name", ["lg55-aca2040", "lg55-reduced", "mk31-imx1600"])
def test_positions_and_regions_lie_on_the_sensor(name: str) -> None:
    rig = load_rig(name)
    positions = led_positions_px(rig)
    assert len(positions) == rig.captures.psf_columns * rig.captures.psf_rows
    assert (positions % 2 == 0).all()
    for x, y in positions:
        region = region_around(rig, float(x), float(y))
        assert (region.columns, region.rows) == (rig.captures.psf_region_columns, rig.captures.psf_region_rows)
        assert region.x % 2 == region.y % 2 == 0
        assert 0 <= region.x <= x <= region.x + region.columns - 2 <= rig.camera.columns
        assert 0 <= region.y <= y <= region.y + region.rows - 2 <= rig.camera.rows
        assert 0.035 * rig.camera.columns < x < 0.965 * rig.camera.columns


def test_shifts_fill_one_bayer_cell() -> None:
    rig = load_rig("lg55-aca2040")
    steps = [step for step in PsfProcedure().steps(rig) if step.id.startswith("psf/p00")]
    offsets = np.array([(step.arrangement.x_px, step.arrangement.y_px) for step in steps]) - led_positions_px(rig)[0]
    assert offsets.min() >= 0
    assert offsets.max() < 2
    cells = {(int(x), int(y)) for x, y in offsets}
    assert cells == {(0, 0), (0, 1), (1, 0), (1, 1)}
    nearest = [np.sort(np.linalg.norm(offsets - offset, axis=1))[1] for offset in offsets]
    assert min(nearest) > 0.3


def test_leds_are_captured_as_brackets(tmp_path: Path) -> None:
    rig = small_rig()
    with simulated_bench(rig) as bench:
        run_procedure(PsfProcedure(), bench, new_writer(tmp_path, rig, bench))
    session = Session.open(tmp_path)
    steps = session.steps("psf")
    assert [step.id for step in steps] == ["psf/p00_s0", "psf/p00_s1", "psf/p01_s0", "psf/p01_s1"]
    well = rig.camera.K_DN_per_e.value * rig.camera.full_well_e.value
    for step in steps:
        exposures = [capture.exposure_s for capture in step.captures]
        np.testing.assert_allclose(np.diff(np.log(exposures)), np.log(4))
        first = session.frame(step.captures[0])
        assert (first.max() - 64.0) / well == pytest.approx(0.8, abs=0.1)
        row, column = np.unravel_index(first.argmax(), first.shape)
        region = step.captures[0].region
        assert abs(region.x + column - step.subject.x_px) < 3
        assert abs(region.y + row - step.subject.y_px) < 3


def test_an_led_that_is_off_is_refused(tmp_path: Path) -> None:
    rig = small_rig()
    with simulated_bench(rig) as bench:
        writer = new_writer(tmp_path, rig, bench)
        with pytest.raises(CaptureError, match="Step psf/p00_s0: Expected to see the LED"):
            run_procedure(PsfProcedure(), replace(bench, stage=DarkStage(bench)), writer)
    assert writer.completed_ids == frozenset()
