from __future__ import annotations

import numpy as np
import pytest

from udccal.restoration.lowrank import KernelGrid, decompose
from udccal.restoration.operator import Blur, Canvas


@pytest.fixture(scope="module")
def blur(toy_grid: KernelGrid) -> Blur:
    return Blur.of(decompose(toy_grid, 1, 0.0, 20), Canvas.around(96, 128, 24, 8, workers=1))


def point(canvas: Canvas, row: int, column: int) -> np.ndarray:
    picture = np.zeros((canvas.rows, canvas.columns), dtype=np.float32)
    canvas.frame(picture)[row, column] = 1.0
    return picture


def test_a_point_brings_the_kernel_of_its_own_place(blur: Blur, toy_grid: KernelGrid) -> None:
    seen = blur.forward(point(blur.canvas, 0, 0))
    top, left = blur.canvas.top, blur.canvas.left
    np.testing.assert_allclose(seen[top - 20 : top + 21, left - 4 : left + 5], toy_grid.kernels[0, 0, 1], atol=1e-5)


def test_the_other_convention_is_another_operator(blur: Blur) -> None:
    """sum_r c_r (h_r * x) weighs with the place where light arrives: wrong by far more than rounding."""
    x = point(blur.canvas, 40, 30)
    canvas = blur.canvas
    at_arrival = sum(
        c * canvas.inverse(h * canvas.transform(x)) for h, c in zip(blur.spectra, blur.coefficients, strict=True)
    )
    ours = blur.forward(x)
    assert np.abs(at_arrival - ours).max() > 3e-3 * ours.max()


def test_adjoint(blur: Blur) -> None:
    rng = np.random.default_rng(0)
    shape = (blur.canvas.rows, blur.canvas.columns)
    x, y = (rng.normal(size=shape).astype(np.float32) for _ in range(2))
    np.testing.assert_allclose(np.vdot(blur.forward(x), y), np.vdot(x, blur.adjoint(y)), rtol=1e-3)


def test_even_light_stays_even(blur: Blur) -> None:
    ones = np.ones((blur.canvas.rows, blur.canvas.columns), dtype=np.float32)
    np.testing.assert_allclose(blur.canvas.frame(blur.forward(ones)), 1.0, atol=0.02)


def test_the_canvas_holds_the_frame_and_its_padding() -> None:
    canvas = Canvas.around(97, 101, 13, 7, workers=1)
    assert canvas.rows >= 97 + 26
    assert canvas.columns >= 101 + 14
    frame = np.arange(97 * 101, dtype=np.float32).reshape(97, 101)
    extended = canvas.extended(frame)
    assert extended.shape == (canvas.rows, canvas.columns)
    np.testing.assert_array_equal(canvas.frame(extended), frame)
    assert extended[0, 0] == frame[0, 0]


def test_a_kernel_larger_than_the_canvas_wraps_round_and_keeps_its_light() -> None:
    canvas = Canvas.around(16, 16, 0, 0, workers=1)
    spectrum = canvas.kernel_spectrum(np.full((41, 5), 1 / 205, dtype=np.float32))
    assert spectrum[0, 0].real == pytest.approx(1.0, abs=1e-5)
