"""A bundle of boards: views, and corners on each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from tests.benchmarks.growth.cases import Case
from tests.fitting.geometry.boards import sight
from udccal.arrangements import BoardSpec
from udccal.board.charuco import board_points_mm
from udccal.fitting.geometry.data import GeometryData
from udccal.fitting.geometry.fit import fit_boards
from udccal.models.geometry import Geometry
from udccal.numerics import in_float64

_VIEWS, _CORNERS = 10, 48
# Boards of about one size, 540 mm x 420 mm, by how many corners they have.
_SQUARES = {48: (9, 7, 60.0), 96: (13, 9, 42.0), 192: (17, 13, 32.0)}
_START = Geometry(np.full(2, 850.0), np.array([511.5, 383.5]), np.zeros(5), np.zeros(3), np.zeros(3))


@in_float64
def _work(views: int, corners: int) -> Callable[[], object]:
    columns, rows, square_mm = _SQUARES[corners]
    spec = BoardSpec(columns, rows, square_mm, 0.75 * square_mm)
    assert len(board_points_mm(spec)) == corners
    seen = sight(views=views)
    scene = replace(seen, spec=spec, sigma_px=np.full((views, corners), float(seen.sigma_px.mean())))
    data = GeometryData(tuple(scene.views(np.random.default_rng(1))), _START, scene.size)
    return lambda: fit_boards(data).or_raise()


CASES = (
    Case("geometry", "views", (10, 20, 40), lambda views: _work(views, _CORNERS)),
    Case("geometry", "corners of a board", tuple(_SQUARES), lambda corners: _work(_VIEWS, corners)),
)
