"""What a fit left over: numbers without a display, and figures that can be drawn."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from udccal.reports.fit_figures import residual_figure
from udccal.reports.residuals import residual_histogram, residual_map
from udccal.result import ResidualSample

_COLUMNS, _ROWS = 640, 480


def _sample(patch_sigma: float = 0.0, spread: float = 1.0) -> ResidualSample:
    """Normal residuals; the lower right quarter of the sensor is off by ``patch_sigma``."""
    rng = np.random.default_rng(4)
    positions = rng.uniform([0, 0], [_COLUMNS - 1, _ROWS - 1], (6000, 2))
    patch = (positions[:, 0] > _COLUMNS / 2) & (positions[:, 1] > _ROWS / 2)
    return ResidualSample(positions, spread * rng.standard_normal(6000) + patch_sigma * patch)


def test_noise_alone_leaves_an_even_map_and_a_normal_histogram() -> None:
    cells, histogram = residual_map(_sample(), _COLUMNS, _ROWS), residual_histogram(_sample())
    values = cells.mean_sigma[np.isfinite(cells.mean_sigma)]
    assert values.size > 200
    assert np.mean(np.abs(values) < 2) == pytest.approx(0.954, abs=0.03)
    assert (histogram.mean, histogram.std) == pytest.approx((0, 1), abs=0.03)
    assert histogram.counts.sum() + histogram.outside == 6000


def test_a_patch_that_the_model_lacks_shows_where_it_is() -> None:
    cells = residual_map(_sample(patch_sigma=1.0), _COLUMNS, _ROWS).mean_sigma
    down, across = cells.shape
    quarter = cells[down // 2 + 1 :, across // 2 + 1 :]
    assert np.nanmean(quarter) > 2
    assert abs(np.nanmean(cells[: down // 2 - 1])) < 0.3


def test_residuals_wider_than_noise_are_counted() -> None:
    histogram = residual_histogram(_sample(spread=3.0))
    assert histogram.std == pytest.approx(3.0, rel=0.05)
    assert histogram.outside > 400


def test_one_residual_is_a_map_of_one_cell() -> None:
    assert residual_map(ResidualSample(np.zeros((1, 2)), np.ones(1)), _COLUMNS, _ROWS).mean_sigma.shape == (1, 1)


def test_the_figure_is_drawn() -> None:
    sample = _sample(patch_sigma=1.0)
    figure = residual_figure(residual_map(sample, _COLUMNS, _ROWS), residual_histogram(sample))
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    assert np.asarray(canvas.buffer_rgba()).std() > 5
