from __future__ import annotations

import numpy as np
import pytest

from tests.simulation.toy import toy_truth
from udccal.errors import UdccalError
from udccal.simulation import backscatter
from udccal.simulation.backscatter import Backscatterer, backscatter_rate, backscatterer, fresnel_reflectance
from udccal.simulation.emission import EMITTER_COLUMN_OFFSETS, EMITTER_ROW_OFFSET, emitter_shares
from udccal.simulation.footprint import converging_footprint
from udccal.simulation.truth import pixels_to_directions


@pytest.fixture(scope="module")
def scatter() -> Backscatterer:
    return backscatterer(toy_truth())


def picture(value: int = 0) -> np.ndarray:
    panel = toy_truth().description.panel
    return np.full((panel.rows, panel.columns, 3), value, np.uint8)


def turned_grid(samples: int) -> np.ndarray:
    """Points of a square around the unit disc, in rows along which no edge runs."""
    axis = (np.arange(samples) + 0.5) / samples * 2.9 - 1.45
    x, y = np.meshgrid(axis, axis)
    return np.stack([np.cos(0.54) * x - np.sin(0.54) * y, np.sin(0.54) * x + np.cos(0.54) * y], axis=-1).reshape(-1, 2)


def test_dark_panel_sends_nothing(scatter: Backscatterer) -> None:
    assert not scatter.rate(picture(0)).any()


def test_a_picture_of_another_size_is_refused(scatter: Backscatterer) -> None:
    with pytest.raises(UdccalError, match=r"Expected a picture of the panel's .* found 20 x 10"):
        scatter.rate(np.zeros((10, 20, 3), np.uint8))


def test_follows_the_transfer_curve(scatter: Backscatterer) -> None:
    ratio = scatter.rate(picture(128)) / scatter.rate(picture(255))
    np.testing.assert_allclose(ratio, (128 / 255) ** scatter.truth.panel.gamma, rtol=1e-5)


def test_light_of_pictures_adds(scatter: Backscatterer) -> None:
    left, right = picture(0), picture(0)
    left[:, :960], right[:, 960:] = 200, 200
    both = scatter.rate(picture(200))
    np.testing.assert_allclose(scatter.rate(left) + scatter.rate(right), both, atol=2e-4 * both.max())
    assert np.abs(scatter.rate(left) - both).max() > 0.3 * both.max()


def test_primaries_are_mixed_by_the_filters(scatter: Backscatterer) -> None:
    rates = np.stack([scatter.rate(picture(0) + np.uint8(255) * np.eye(3, dtype=np.uint8)[i]) for i in range(3)])
    measured = np.stack([rates[:, 0::2, 0::2], rates[:, 0::2, 1::2], rates[:, 1::2, 1::2]]).mean(axis=(2, 3))
    mix = scatter.truth.panel.primaries
    np.testing.assert_allclose(measured / measured[1, 1], mix / mix[1, 1], rtol=0.02)


def test_white_level_is_leak_plus_reflection(scatter: Backscatterer) -> None:
    panel = scatter.truth.panel
    green = scatter.rate(picture(255))[0::2, 1::2].mean()
    expected = (panel.leak_e_per_s + panel.reflection_e_per_s) * panel.primaries[1].sum()
    assert green == pytest.approx(expected, rel=0.1)


@pytest.mark.parametrize(("depth_mm", "primary"), [(0.0, 0), (0.92, 2)])
def test_shares_are_the_area_of_emitters_inside_the_footprint(depth_mm: float, primary: int) -> None:
    truth = toy_truth()
    directions = pixels_to_directions(truth.optics, np.array([[20.0, 70.0]]))
    shares = (
        emitter_shares(truth, directions, depth_mm, np.ones(1), primary)
        .toarray()
        .reshape(truth.description.panel.rows, -1)
    )
    centre, shape = converging_footprint(truth, directions, depth_mm)
    u = turned_grid(1500)
    x, y = ((centre[0] + u[(u**2).sum(axis=1) < 1] @ shape[0].T) / truth.panel.pitch_mm).T
    row, column = np.floor(y).astype(int), np.rint(x - EMITTER_COLUMN_OFFSETS[primary]).astype(int)
    height, width = 0.5 * (1 - truth.panel.row_open), 0.22
    hit = np.abs(y - row - EMITTER_ROW_OFFSET) < height / 2
    hit &= np.abs(x - EMITTER_COLUMN_OFFSETS[primary] - column) < width / 2
    sampled = np.zeros_like(shares)
    np.add.at(sampled, (row[hit], column[hit]), 1 / (len(x) * height * width))
    assert np.abs(sampled - shares).max() < 0.03 * shares.max()
    assert np.abs(np.roll(sampled, 1, axis=0) - shares).max() > 0.5 * shares.max()


def test_coarse_grid_is_fine_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    coarse = backscatter_rate(toy_truth(), picture(255))
    monkeypatch.setattr(backscatter, "_SAMPLES_PER_PERIOD", 40)
    fine = backscatter_rate(toy_truth(), picture(255))
    assert (coarse - fine).std() < 1.5e-3 * fine.max()
    monkeypatch.setattr(backscatter, "_SAMPLES_PER_PERIOD", 2)
    too_coarse = backscatter_rate(toy_truth(), picture(255))
    assert (too_coarse - fine).std() > 3e-3 * fine.max()


def test_fresnel_at_normal_incidence_and_growing() -> None:
    reflectance = fresnel_reflectance(1.5, np.array([1.0, 0.5, 0.2]))
    assert reflectance[0] == pytest.approx(0.04)
    assert (np.diff(reflectance) > 0).all()
