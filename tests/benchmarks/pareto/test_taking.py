"""Frames, the processes that restore them, and rigs that are cut, on the shipped profile and a toy rig."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.benchmarks.pareto.exponents import cut
from tests.benchmarks.pareto.fine_scenes import fine_scenes
from tests.benchmarks.pareto.restoring import Setup, Taken, TierProcess
from tests.benchmarks.scenes import DISTANCE_MM
from tests.simulation.toy import toy_truth
from udccal.io.png import write_rgb8
from udccal.restoration.plan import PlanOptions
from udccal.restoration.runtime import Restorer
from udccal.restoration.tone import Tone
from udccal.tiers import Tier

RIG = "lg55-reduced"
EXPOSURE_S = 0.01


@pytest.fixture(scope="module")
def preview() -> Restorer:
    return Restorer.load(RIG, Tier.preview)


@pytest.fixture(scope="module")
def taken(preview: Restorer) -> Taken:
    camera = preview.rig.camera
    frame = 64 + np.random.default_rng(3).poisson(1000.0, (camera.rows, camera.columns))
    return Taken(frame.astype(np.uint16), EXPOSURE_S, None)


def test_a_cut_rig_sees_the_same_part_of_its_sensor(preview: Restorer, taken: Taken) -> None:
    camera = preview.rig.camera
    rows, columns = camera.rows // 2, camera.columns // 2
    half = cut(preview, rows, columns)
    picture = half.display(np.ascontiguousarray(taken.frame[:rows, :columns]), EXPOSURE_S, Tone(1e-6))
    assert picture.shape == (preview.view.rows // 2, preview.view.columns // 2, 3)
    for own, whole, side in (
        (half.rectification.map_x, preview.rectification.map_x, columns),
        (half.rectification.map_y, preview.rectification.map_y, rows),
    ):
        assert own.min() >= 0
        assert own.max() < side
        assert np.ptp(own) / np.ptp(whole) == pytest.approx(0.5, abs=0.01)


@pytest.mark.medium
def test_a_process_restores_as_this_one_does_and_tells_its_cost(
    preview: Restorer, taken: Taken, tmp_path: Path
) -> None:
    with TierProcess(Setup(RIG, Tier.preview, PlanOptions(), tmp_path)) as process:
        assert process.ready_s(taken) > 0
        restored = process.restored(taken)
    assert np.array_equal(restored.linear, preview.restore(taken.frame, EXPOSURE_S))
    assert 0 < restored.cost.ms < 10_000
    assert restored.cost.cpu_ms > 0
    assert 50 < restored.cost.peak_MiB < 5_000


def test_a_texel_of_a_fine_scene_is_a_pixel_of_the_sensor(tmp_path: Path) -> None:
    rng, truth = np.random.default_rng(4), toy_truth()
    for name in ("photos", "environments"):
        (tmp_path / name).mkdir()
    for index in range(2):
        write_rgb8(tmp_path / "photos" / f"{index}.png", rng.integers(0, 256, (40, 60, 3), dtype=np.uint8))
    for name in ("lobby", "park"):
        assert cv2.imwrite(str(tmp_path / "environments" / f"{name}.hdr"), rng.random((16, 32, 3), dtype=np.float32))
    scenes = fine_scenes(tmp_path, truth)
    assert [scene.name for scene in scenes] == ["mosaic 1", "mosaic 2", "mosaic 3", "lobby bands", "park bands"]
    camera, pixel = truth.description.camera, 1 / truth.optics.fx_px
    for scene in scenes:
        texel = scene.width_mm / scene.radiance.shape[1] / (DISTANCE_MM - float(truth.optics.pupil_mm[2]))
        assert texel == pytest.approx(pixel)
    assert scenes[0].radiance.shape[0] >= camera.rows
    assert scenes[0].radiance.shape[1] >= camera.columns
    assert [scene.name for scene in fine_scenes(tmp_path, truth, every=4)] == ["mosaic 1", "park bands"]
