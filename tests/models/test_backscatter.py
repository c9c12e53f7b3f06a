from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import pytest

from udccal.models import backscatter as b
from udccal.models.geometry import Geometry
from udccal.numerics import in_float64

PANEL_ROWS, PANEL_COLUMNS = 120, 160


def term(columns: int = 64, rows: int = 48, step: int = 4) -> b.Backscatter:
    shape = (3, rows // step, columns // step)
    mask = np.random.default_rng(1).uniform(0.8, 1.2, (3, 1, 1)) * np.linspace(900, 1100, shape[1] * shape[2]).reshape(
        shape[1:]
    )
    return b.Backscatter(
        geometry=Geometry(
            focal_px=np.array([54.0, 54.0]),
            principal_point_px=np.array([31.5, 23.5]),
            distortion=np.array([-0.07, 0.03, 0.0, 0.0, 0.0]),
            rotation_rad=np.array([-0.3, 0.02, 0.01]),
            pupil_mm=np.array([50.0, 30.0, -14.0]),
        ),
        mask=mask,
        mix=np.array([[0.8, 0.15, 0.05], [0.1, 0.8, 0.1], [0.02, 0.18, 0.8]]),
        gamma=np.float64(2.2),
        pitch_mm=np.float64(0.63),
        pupil_diameter_mm=np.float64(3.2),
        standoff_mm=np.float64(14.3),
        emitters_px=np.array([[-0.3, 0.5], [0.0, 0.5], [0.3, 0.5]]),
        softness_px=np.float64(0.1),
        reflection=np.float64(0.6),
        reflection_mm=np.float64(0.92),
        columns=columns,
        rows=rows,
        cfa="RGGB",
        step=step,
        window=15,
    )


def grey(level: int) -> np.ndarray:
    return np.full((PANEL_ROWS, PANEL_COLUMNS, 3), level, np.uint8)


@in_float64
def rate(of: b.Backscatter, picture: np.ndarray) -> np.ndarray:
    return np.asarray(b.backscatter_rate(of, picture))


@in_float64
def typical(of: b.Backscatter, level: float) -> np.ndarray:
    return np.asarray(b.typical_rate(of, level))


@pytest.mark.medium
def test_white_gives_the_mask_black_gives_nothing() -> None:
    white = rate(term(), grey(255))
    np.testing.assert_allclose(white, typical(term(), 255.0), rtol=1e-9)
    block = white[0:4, 0:4]
    assert block[0::2, 0::2].mean() == pytest.approx(float(np.asarray(term().mask)[0, 0, 0]), rel=0.02)
    assert rate(term(), grey(0)).max() == 0.0


def test_an_even_grey_follows_the_transfer_curve() -> None:
    np.testing.assert_allclose(rate(term(), grey(128)), rate(term(), grey(255)) * (128 / 255) ** 2.2, rtol=1e-9)


def test_a_wrong_gamma_does_not_pass() -> None:
    other = replace(term(), gamma=np.float64(2.0))
    assert np.abs(rate(other, grey(128)) / rate(term(), grey(255)) - (128 / 255) ** 2.2).min() > 0.02


def test_the_footprint_is_where_rays_from_the_pupil_meet_the_panel() -> None:
    """Rays traced one by one through the pupil's rim against the ellipse."""
    pixels = np.array([[3.0, 40.0], [31.0, 20.0], [60.0, 5.0]])
    one = term()
    with jax.enable_x64(True):
        centre, shape = (np.asarray(a) for a in b.footprints(one, b.panel_directions(one.geometry, pixels), 14.3))
        rays = np.asarray(b.panel_directions(one.geometry, pixels))
        rotation = np.asarray(b.rotation_matrix(one.geometry.rotation_rad))
    angles = np.linspace(0, 2 * np.pi, 12)
    rim = np.stack([np.cos(angles), np.sin(angles)])
    for ray, middle, ellipse in zip(rays, centre, shape, strict=True):
        start = one.geometry.pupil_mm + (rotation[:, :2] @ rim).T * 1.6
        start[:, 2] += 14.0 - 14.3
        met = start - ray * (start[:, 2:] / ray[2])
        np.testing.assert_allclose((middle + (ellipse @ rim).T) * 0.63, met[:, :2], atol=1e-9)


@pytest.mark.medium
def test_shares_add_up_to_the_footprint() -> None:
    pixels = np.random.default_rng(0).uniform([0, 0], [63, 47], (60, 2))
    with jax.enable_x64(True):
        rays = b.panel_directions(term().geometry, pixels)
        shares = np.asarray(b.emitter_shares(term(), rays, b.window_corners(term(), rays))).sum(axis=1)
    assert shares.mean() == pytest.approx(1.0, abs=0.01)
    assert np.abs(shares - 1).max() < 0.12


@pytest.mark.medium
def test_a_window_too_small_loses_light() -> None:
    pixels = np.random.default_rng(0).uniform([0, 0], [63, 47], (60, 2))
    small = replace(term(), window=3)
    with jax.enable_x64(True):
        rays = b.panel_directions(small.geometry, pixels)
        shares = np.asarray(b.emitter_shares(small, rays, b.window_corners(small, rays))).sum(axis=1)
    assert shares.max() < 0.7


@pytest.mark.medium
def test_a_red_panel_reaches_all_colours_through_the_mix() -> None:
    red = grey(0)
    red[..., 0] = 255
    with jax.enable_x64(True):
        response = b.panel_response(term(), PANEL_ROWS, PANEL_COLUMNS)
        grid = np.asarray(b.response_grid(response, red)) / np.asarray(term().mask)
    np.testing.assert_allclose(np.median(grid, axis=(1, 2)), [0.8, 0.1, 0.02], rtol=0.05)


def test_light_moves_with_the_picture() -> None:
    """A bright left half of the panel lights the left of the sensor (nothing is mirrored)."""
    with jax.enable_x64(True):
        ray = b.panel_directions(term().geometry, np.array([[31.5, 23.5]]))
        middle = float(b.footprints(term(), ray, 14.3)[0][0, 0])
    half = grey(0)
    half[:, : round(middle)] = 255
    seen = rate(term(), half)
    assert seen[:, :16].mean() > 100 * max(seen[:, 48:].mean(), 1e-9)


def test_beyond_the_panel_is_dark_and_finite() -> None:
    moved = replace(term(), emitters_px=np.array([[500.0, 0.0]] * 3))
    assert rate(moved, grey(255)).max() == 0.0


@pytest.mark.medium
def test_interpolation_from_the_grid_keeps_a_slanted_plane() -> None:
    x, y = np.meshgrid(4 * (np.arange(16) + 0.5) - 0.5, 4 * (np.arange(12) + 0.5) - 0.5)
    grid = np.stack([2 * x + 3 * y + 5] * 3)
    with jax.enable_x64(True):
        mosaic = np.asarray(b.mosaic_of_grid(term(), grid))
    columns, rows = np.meshgrid(np.arange(64), np.arange(48))
    np.testing.assert_allclose(mosaic, 2 * columns + 3 * rows + 5, atol=1e-9)


@pytest.mark.medium
def test_a_long_grid_compiled_is_the_same_as_step_by_step() -> None:
    """Some versions of jaxlib miscompile small matrix products over more than 16384 positions."""
    large = term(columns=512, rows=384, step=2)
    wider = replace(large.geometry, focal_px=np.array([430.0, 430.0]), principal_point_px=np.array([255.0, 191.0]))
    large = replace(large, geometry=wider)
    picture = np.random.default_rng(0).integers(0, 256, (PANEL_ROWS, PANEL_COLUMNS, 3)).astype(np.uint8)
    with jax.enable_x64(True):
        response = b.panel_response(large, PANEL_ROWS, PANEL_COLUMNS)
        compiled = np.asarray(jax.jit(b.response_grid)(response, picture))
    light = (picture.reshape(-1, 3)[np.asarray(response.pixels)] / 255.0) ** 2.2
    gathered = (np.asarray(response.shares) * light).sum(axis=1)
    by_hand = np.asarray(response.gain) * (gathered @ large.mix.T).T
    np.testing.assert_allclose(compiled, by_hand.reshape(compiled.shape), rtol=1e-9)
