from __future__ import annotations

import numpy as np
import pytest

from tests.simulation.toy import toy_truth
from udccal.simulation.blur import SpaceVariantBlur, build_blur, low_rank
from udccal.simulation.psf import phase_averaged_kernels

ROWS, COLUMNS = 7, 5


def toy_blur(coefficients: np.ndarray) -> SpaceVariantBlur:
    components = np.random.default_rng(4).random((3, coefficients.shape[0], ROWS, COLUMNS))
    grid_rows, grid_columns = coefficients.shape[1:]
    return SpaceVariantBlur(
        components, coefficients, np.linspace(0, 11, grid_columns), np.linspace(0, 15, grid_rows), 0.0
    )


def kernel_of(blur: SpaceVariantBlur, colour: int, node: tuple[int, int]) -> np.ndarray:
    return np.tensordot(blur.coefficients[:, node[0], node[1]], blur.components[colour], axes=1)


def explicit_sum(blur: SpaceVariantBlur, canvas: np.ndarray, colour: int) -> np.ndarray:
    """Every source pixel spreads its own kernel; grid nodes must lie on every sensor pixel."""
    margin_rows, margin_columns = blur.margin
    rows, columns = canvas.shape[0] - 2 * margin_rows, canvas.shape[1] - 2 * margin_columns
    wide = np.zeros((canvas.shape[0] + 2 * margin_rows, canvas.shape[1] + 2 * margin_columns))
    for j in range(canvas.shape[0]):
        for i in range(canvas.shape[1]):
            node = int(np.clip(j - margin_rows, 0, rows - 1)), int(np.clip(i - margin_columns, 0, columns - 1))
            wide[j : j + ROWS, i : i + COLUMNS] += canvas[j, i, colour] * kernel_of(blur, colour, node)
    top, left = 2 * margin_rows, 2 * margin_columns
    return wide[top : top + rows, left : left + columns]


@pytest.fixture(scope="module")
def varying() -> tuple[SpaceVariantBlur, np.ndarray]:
    rng = np.random.default_rng(5)
    blur = toy_blur(rng.random((2, 16, 12)))
    return blur, rng.random((16 + ROWS - 1, 12 + COLUMNS - 1, 3))


def test_low_rank_equals_the_explicit_sum_over_sources(varying: tuple[SpaceVariantBlur, np.ndarray]):
    blur, canvas = varying
    blurred = blur.apply(canvas)
    assert blurred.shape == (16, 12, 3)
    for colour in range(3):
        expected = explicit_sum(blur, canvas, colour)
        assert np.abs(blurred[..., colour] - expected).max() < 1e-5 * expected.max()


def test_the_kernel_belongs_to_the_source_not_to_the_pixel(varying: tuple[SpaceVariantBlur, np.ndarray]):
    """sum_r h_r * (c_r x) is not sum_r c_r (h_r * x)."""
    blur, canvas = varying
    by_pixel = np.zeros((16, 12))
    for component, coefficients in zip(blur.components[1], blur.coefficients, strict=True):
        ones = SpaceVariantBlur(
            np.repeat(component[None, None], 3, axis=0), np.ones((1, 1, 1)), np.zeros(1), np.zeros(1), 0.0
        )
        by_pixel += coefficients * ones.apply(canvas)[..., 1]
    expected = explicit_sum(blur, canvas, 1)
    assert np.abs(by_pixel - expected).max() > 0.05 * expected.max()
    assert np.abs(blur.apply(canvas)[..., 1] - expected).max() < 1e-5 * expected.max()


def test_a_point_gives_the_kernel_the_right_way_round():
    blur = toy_blur(np.ones((1, 1, 1)))
    canvas = np.zeros((22, 16, 3))
    canvas[10, 8] = 1.0
    found = blur.apply(canvas)[10 - 6 : 10 + 1, 8 - 4 : 8 + 1]
    assert np.allclose(np.moveaxis(found, -1, 0), blur.components[:, 0], atol=1e-6)


def test_a_scene_of_one_colour_is_the_same_in_all(varying: tuple[SpaceVariantBlur, np.ndarray]):
    blur, canvas = varying
    grey = canvas[..., :1]
    np.testing.assert_array_equal(blur.apply(grey), blur.apply(np.repeat(grey, 3, axis=-1)))


def test_rank_is_as_small_as_the_tolerance_allows():
    rng = np.random.default_rng(6)
    stack = (rng.random((9, 2)) @ rng.random((3, 2, 40))).astype(np.float32)
    components, coefficients, error = low_rank(stack, 8, 1e-3)
    assert components.shape[1] == 2
    assert error <= 1e-3
    assert np.allclose(np.einsum("rn,crs->cns", coefficients, components), stack, atol=1e-4)
    _, _, cut = low_rank(stack, 1, 1e-3)
    assert cut > 1e-3


def test_built_blur_meets_the_kernels_on_its_grid():
    truth = toy_truth()
    blur = build_blur(truth, 3, 2, 33, 17, tolerance=1e-3)
    assert blur.relative_error <= 1e-3
    canvas = np.zeros((96 + 32, 128 + 16, 3))
    canvas[16 + 95, 8 + 127] = 1.0
    expected = phase_averaged_kernels(truth, np.array([[127.0, 95.0]]), 33, 17)[0]
    found = np.moveaxis(blur.apply(canvas)[-17:, -9:], -1, 0)
    assert np.abs(found - expected[:, :17, :9]).max() < 5e-3 * expected.max()


def test_a_smaller_blur_keeps_the_middle_of_the_first_components():
    blur = toy_blur(np.ones((4, 2, 2)))
    small = blur.smaller(2, 3, 9)
    assert small.components.shape == (3, 2, 3, COLUMNS)
    np.testing.assert_array_equal(small.components, blur.components[:, :2, 2:5])
    np.testing.assert_array_equal(small.coefficients, blur.coefficients[:2])


def test_even_light_stays_even():
    blur = build_blur(toy_truth(), 2, 2, 33, 17)
    even = blur.apply(np.ones((96 + 32, 128 + 16, 3)))
    assert np.allclose(even, 1.0, atol=5e-3)


def test_light_is_never_less_than_none_beside_a_flame() -> None:
    down, across = np.arange(ROWS) - ROWS // 2, np.arange(COLUMNS) - COLUMNS // 2
    sharp = np.exp(-0.5 * (down[:, None] ** 2 + across**2) / 0.4**2)
    blur = SpaceVariantBlur(np.tile(sharp, (3, 1, 1, 1)), np.ones((1, 1, 1)), np.zeros(1), np.zeros(1), 0.0)
    canvas = np.zeros((16 + ROWS - 1, 12 + COLUMNS - 1, 3))
    canvas[9, 7] = 1e9
    assert blur.apply(canvas).min() >= 0.0
