from __future__ import annotations

import numpy as np
import pytest

from udccal.errors import RestorationError
from udccal.models.geometry import Geometry, VirtualView
from udccal.restoration.rectify import Rectification
from udccal.restoration.view import inscribed_view


def corners_fit(geometry: Geometry, view: VirtualView, slack: float) -> bool:
    maps = Rectification.of(geometry, view)
    inside = (maps.map_x >= 1.28 - slack) & (maps.map_x <= 127 - 1.28 + slack)
    inside &= (maps.map_y >= 0.96 - slack) & (maps.map_y <= 95 - 0.96 + slack)
    return bool(inside.all())


def test_the_view_fills_the_sensor_and_no_more(toy_geometry: Geometry) -> None:
    view = inscribed_view(toy_geometry, 128, 96, 96, 54)
    assert (view.columns, view.rows) == (96, 54)
    assert corners_fit(toy_geometry, view, 0.05)
    # Anything a few percent wider, whatever its centre, sticks out on one side or the other.
    for shift in ((0, 0), (1.5, 0), (-1.5, 0), (0, 1.5), (0, -1.5)):
        wider = VirtualView(96, 54, view.focal_px * 0.95, np.asarray(view.principal_point_px) + shift)
        assert not corners_fit(toy_geometry, wider, 0.05)


def test_up_is_up_and_left_is_left(toy_geometry: Geometry) -> None:
    """The camera is tilted down by 17 degrees, not turned over: the view keeps the sensor's order."""
    maps = Rectification.of(toy_geometry, inscribed_view(toy_geometry, 128, 96, 96, 54))
    assert (np.diff(maps.map_x, axis=1) > 0).all()
    assert (np.diff(maps.map_y, axis=0) > 0).all()


def test_a_rectified_picture_shows_what_the_map_says(toy_geometry: Geometry) -> None:
    view = inscribed_view(toy_geometry, 128, 96, 96, 54)
    maps = Rectification.of(toy_geometry, view)
    y, x = np.mgrid[:96, :128].astype(np.float32)
    seen = maps.apply(np.stack([x, y, x + y], axis=-1))
    np.testing.assert_allclose(seen[4:-4, 4:-4, 0], maps.map_x[4:-4, 4:-4], atol=0.04)
    np.testing.assert_allclose(seen[4:-4, 4:-4, 1], maps.map_y[4:-4, 4:-4], atol=0.04)


def test_a_camera_that_looks_away_is_refused(toy_geometry: Geometry) -> None:
    away = Geometry(**{**vars(toy_geometry), "rotation_rad": np.array([0.0, 2.5, 0.0])})
    with pytest.raises(RestorationError, match="front of the panel"):
        inscribed_view(away, 128, 96, 96, 54)


def test_a_view_that_looks_beside_the_sensor_is_refused(toy_geometry: Geometry) -> None:
    view = inscribed_view(toy_geometry, 128, 96, 96, 54)
    Rectification.within(toy_geometry, view, 128, 96)
    wider = VirtualView(96, 54, view.focal_px * 0.8, view.principal_point_px)
    with pytest.raises(RestorationError, match="look past it"):
        Rectification.within(toy_geometry, wider, 128, 96)
