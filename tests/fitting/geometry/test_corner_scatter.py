"""Scatter in addition to noise: found at its size, and absent where there is none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.fitting.geometry.boards import COMMON_PX, sight
from udccal.fitting.geometry.corners import BoardCorners
from udccal.fitting.geometry.data import GeometryData
from udccal.fitting.geometry.fit import fit_boards
from udccal.models.geometry import Geometry
from udccal.result import FitResult, FitStatus

START = Geometry(np.full(2, 850.0), np.array([511.5, 383.5]), np.zeros(5), np.zeros(3), np.zeros(3))


def fitted(sigma_scale: float) -> FitResult[Geometry]:
    """Views whose corners give ``sigma_scale`` times their noise as sigma, and have a common scatter in addition."""
    scene = sight(views=12, sigma_px=0.06)
    views = scene.views(np.random.default_rng(5))
    told = [
        replace(view, corners=replace(view.corners, sigma=sigma_scale * view.corners.sigma + (sigma_scale > 1) * 0.2))
        for view in views
    ]
    return fit_boards(GeometryData(tuple(told), START, scene.size))


def scatter_px(result: FitResult[Geometry]) -> float:
    return next(d.value for d in result.diagnostics if d.name == "corner_scatter_beside_noise")


def test_what_corners_scatter_beside_noise_is_found() -> None:
    result = fitted(1.0)
    assert scatter_px(result) == pytest.approx(COMMON_PX, rel=0.1)
    assert result.chi2_dof == pytest.approx(1.0, abs=0.1)


def test_noise_that_says_more_than_corners_scatter_leaves_nothing_beside_it() -> None:
    result = fitted(1.5)
    assert scatter_px(result) == 0.0
    assert result.chi2_dof < 0.3


def test_corners_without_any_scatter_give_the_lens_itself() -> None:
    scene = sight(views=12, sigma_px=0.0)
    exact = [
        replace(view, corners=BoardCorners(view.corners.ids, truth[view.corners.ids], np.zeros(len(view.corners.ids))))
        for view, truth in zip(scene.views(np.random.default_rng(0)), scene.corners_px(), strict=True)
    ]
    result = fit_boards(GeometryData(tuple(exact), START, scene.size))
    assert result.status is FitStatus.CONVERGED
    assert np.isfinite(result.cov).all()
    np.testing.assert_allclose(result.term.focal_px, scene.camera.focal_px, atol=1e-4)
