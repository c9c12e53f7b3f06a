from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from procedures.aiming import nominal_pixels
from procedures.base import run_procedure
from procedures.geometry import GeometryProcedure, board_poses, board_spec
from tests.procedures.benches import new_writer, simulated_bench
from udccal.arrangements import Board
from udccal.mounting import nominal_rotation
from udccal.rig import RigDescription, load_rig
from udccal.sessions.store import Session


def corners_px(rig: RigDescription, board: Board) -> np.ndarray:
    spec = board.spec
    grid = np.stack(np.meshgrid(np.arange(1, spec.columns), np.arange(1, spec.rows)), axis=-1).reshape(-1, 2)
    points = np.concatenate([grid * spec.square_mm, np.zeros((len(grid), 1))], axis=1)
    turn = cv2.Rodrigues(np.array(board.rotation_vector))[0]
    return nominal_pixels(rig, points @ turn.T + np.array(board.translation_mm))


@pytest.mark.parametrize("name", ["lg55-aca2040", "lg55-reduced", "mk31-imx1600"])
def test_boards_cover_the_field_and_lean_every_way(name: str) -> None:
    rig = load_rig(name)
    size = np.array([rig.camera.columns, rig.camera.rows])
    boards = list(board_poses(rig, board_spec(rig), rig.captures.board_views))
    covered = np.zeros((6, 6), int)
    leans = []
    for board in boards:
        places = corners_px(rig, board) / size
        inside = places[((places > 0) & (places < 1)).all(axis=1)]
        assert len(inside) >= 0.5 * len(places)
        np.add.at(covered, tuple((inside[:, ::-1] * 6).astype(int).T), 1)
        leans.append(nominal_rotation(rig).T @ cv2.Rodrigues(np.array(board.rotation_vector))[0][:, 2])
    assert covered.min() >= 3
    across = np.array(leans)[:, :2]
    assert across.min() < -0.4
    assert across.max() > 0.4


def test_the_board_on_the_jig_is_parallel_to_the_panel() -> None:
    rig = load_rig("lg55-aca2040")
    (step,) = (step for step in GeometryProcedure().steps(rig) if step.id == "geometry/panel")
    assert step.arrangement.parallel_to_panel
    assert step.arrangement.rotation_vector == (0.0, 0.0, 0.0)
    places = corners_px(rig, step.arrangement) / [rig.camera.columns, rig.camera.rows]
    assert places.min() > 0.05
    assert places.max() < 0.95


@pytest.mark.slow
def test_boards_are_captured_and_found(tmp_path: Path) -> None:
    rig = load_rig("lg55-reduced")
    camera = rig.camera.model_copy(update={"columns": 512, "rows": 384, "pitch_um": 13.8})
    rig = rig.model_copy(update={"camera": camera, "captures": rig.captures.model_copy(update={"board_views": 3})})
    with simulated_bench(rig) as bench:
        run_procedure(GeometryProcedure(), bench, new_writer(tmp_path, rig, bench))
    steps = Session.open(tmp_path).steps("geometry")
    assert [step.id for step in steps] == ["geometry/panel", *(f"geometry/view_{index}" for index in range(3))]
    assert [step.subject.parallel_to_panel for step in steps] == [True, False, False, False]
