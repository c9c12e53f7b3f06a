"""Tables for three colours at every pixel, against the matrices that they stand for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from udccal.restoration.colour_tables import ColourTables, colour_tables
from udccal.restoration.filter_tables import SPARSE
from udccal.restoration.kernel_grid import KernelGrid, centred
from udccal.restoration.scene_prior import COLOURS, STRENGTHS, prior_density
from udccal.restoration.tiles import LEAST_PX, layout_for

STRENGTH = np.float32(16.0)


@pytest.fixture
def kernels() -> np.ndarray:
    """One of them swallows a frequency."""
    drawn = np.random.default_rng(1).random((3, 5, 3))
    drawn[1] = 0
    drawn[1, 1::2, 1] = 0.5
    return drawn


@pytest.fixture
def tables(kernels: np.ndarray) -> ColourTables:
    layout = layout_for(LEAST_PX, LEAST_PX, (1, 1), (LEAST_PX, LEAST_PX), (0, 8))
    return colour_tables(KernelGrid(np.zeros(1), np.zeros(1), kernels[None, None]), layout, 1).at(0)


@pytest.fixture
def spectra(tables: ColourTables) -> np.ndarray:
    rng = np.random.default_rng(2)
    return (rng.normal(size=(2, *tables.transfer.shape)) * [[[[1]]], [[[1j]]]]).sum(axis=0).astype(np.complex64)


def covariance(kernels: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """B, with colours as the last axes."""
    density = prior_density(rows, columns)[:, : columns // 2 + 1]
    seen = np.moveaxis(np.fft.rfft2([centred(kernel, rows, columns) for kernel in kernels]), 0, -1)
    return density[..., None, None] * seen[..., None] * np.conj(seen[..., None, :]) * COLOURS


def test_they_solve_the_equations_of_three_colours(
    tables: ColourTables, spectra: np.ndarray, kernels: np.ndarray
) -> None:
    rows, columns = tables.density.shape[0], 2 * (tables.density.shape[1] - 1)
    assert np.abs(tables.transfer[1]).min() < 1e-7
    matrix = covariance(kernels, rows, columns) + np.eye(3) / STRENGTH
    right = np.moveaxis(spectra, 0, -1).astype(complex)[..., None]
    expected = np.moveaxis(np.linalg.solve(matrix, right)[..., 0], -1, 0)
    found = tables.solved(tables.along(spectra.copy()), STRENGTH)
    within = 1e-5 * float(np.abs(expected).max())
    np.testing.assert_allclose(found, expected, atol=within)
    mirrored = replace(tables, transfer=np.conj(tables.transfer))
    assert np.abs(mirrored.solved(spectra.copy(), STRENGTH) - expected).max() > 100 * within


def test_costs_are_the_likelihood_of_every_third_frequency(
    tables: ColourTables, spectra: np.ndarray, kernels: np.ndarray
) -> None:
    rows, columns = tables.density.shape[0], 2 * (tables.density.shape[1] - 1)
    some = covariance(kernels, rows, columns)[::SPARSE, ::SPARSE]
    y = np.moveaxis(spectra, 0, -1).astype(complex)[::SPARSE, ::SPARSE, :, None]
    expected = []
    for strength in STRENGTHS:
        matrix = strength * some + np.eye(3)
        square = (np.conj(y) * np.linalg.solve(matrix, y)).real.sum() / 2.0
        expected.append(np.linalg.slogdet(matrix)[1].sum() + square)
    costs = tables.costs(spectra, 2.0)
    np.testing.assert_allclose(costs(STRENGTHS), expected, rtol=1e-4)
    blind = replace(tables, transfer=0 * tables.transfer).costs(spectra, 2.0)
    assert not np.allclose(blind(STRENGTHS), expected, rtol=1e-2)


def test_the_picture_filter_is_the_priors_power_and_the_conjugate_transfer(
    tables: ColourTables, kernels: np.ndarray
) -> None:
    rows, columns = tables.density.shape[0], 2 * (tables.density.shape[1] - 1)
    seen = np.fft.rfft2([centred(kernel, rows, columns) for kernel in kernels])
    density = prior_density(rows, columns)[:, : columns // 2 + 1]
    np.testing.assert_allclose(tables.matched[0], density * np.conj(seen), rtol=1e-4, atol=1e-6 * density.max())
