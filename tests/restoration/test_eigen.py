"""Eigenvalues of many 3 x 3 matrices at once, and tables that are made of them."""

from __future__ import annotations

import numpy as np
import pytest

from udccal.restoration.deblur import THREE_COLOURS
from udccal.restoration.eigen import eigen_of_three
from udccal.restoration.kernel_grid import centred
from udccal.restoration.mosaic_filter import COLOURS, _tables_of


def rebuilt(values: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    return np.einsum("iky,ky,jky->ijy", vectors, values, vectors)


@pytest.fixture
def matrices() -> np.ndarray:
    """Covariances of many sizes, some of low rank, and one of zeros."""
    rng = np.random.default_rng(0)
    factors = rng.normal(size=(3, 3, 2000))
    factors[:, 1:, :500] = 0
    found = np.einsum("iky,jky->ijy", factors, factors) * 10.0 ** rng.uniform(-12, 12, 2000)
    found[..., -1] = 0
    return found


def test_they_are_those_of_lapack(matrices: np.ndarray) -> None:
    values, vectors = eigen_of_three(matrices)
    size = np.abs(matrices).max(axis=(0, 1)) + 1e-300
    assert np.max(np.abs(rebuilt(values, vectors) - matrices) / size) < 1e-13
    expected = np.linalg.eigvalsh(np.moveaxis(matrices, -1, 0)).T
    assert np.max(np.abs(np.sort(values, axis=0) - expected) / size) < 1e-13
    np.testing.assert_allclose(
        np.einsum("iky,ily->kly", vectors, vectors), np.eye(3)[..., None] * np.ones(2000), atol=1e-13
    )


def test_equal_eigenvalues_and_diagonal_matrices_need_no_rotation() -> None:
    diagonal = np.diag([2.0, 1.0, 2.0])[..., None]
    values, vectors = eigen_of_three(diagonal)
    assert values[:, 0].tolist() == [2.0, 1.0, 2.0]
    np.testing.assert_array_equal(vectors[..., 0], np.eye(3))


def test_the_lower_triangle_is_not_read_and_another_matrix_has_other_eigenvalues(matrices: np.ndarray) -> None:
    values, _ = eigen_of_three(matrices)
    changed = matrices.copy()
    changed[2, 0] = 7.0
    np.testing.assert_array_equal(eigen_of_three(changed)[0], values)
    changed[0, 2] = 7.0
    assert not np.allclose(eigen_of_three(changed)[0], values)


def test_tables_without_aliases_hold_the_covariance_of_the_three_colours() -> None:
    rng = np.random.default_rng(1)
    kernels = rng.random((3, 5, 3))
    # It swallows a frequency.
    kernels[1] = 0
    kernels[1, 1::2, 1] = 0.5
    density = rng.random((8, 12)) + 0.1
    matched, vectors, values = _tables_of(kernels, density, THREE_COLOURS)
    seen, half = np.fft.rfft2([centred(kernel, 8, 12) for kernel in kernels]), density[:, :7]
    assert np.abs(seen[1]).min() < 1e-12
    expected = half * seen[:, None] * np.conj(seen) * COLOURS[..., None, None]
    within = {"rtol": 1e-5, "atol": 1e-6 * float(np.abs(expected).max())}
    found = np.einsum("kiyx,kyx,kjyx->ijyx", np.conj(vectors), values, vectors)
    np.testing.assert_allclose(found, expected, **within)
    np.testing.assert_allclose(matched[0], half * np.conj(seen), **within)
    mirrored = np.einsum("kiyx,kyx,kjyx->ijyx", vectors, values, np.conj(vectors))
    assert np.abs(mirrored - expected).max() > 100 * within["atol"]
