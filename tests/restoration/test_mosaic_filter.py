"""The filter against the dense solution of the same problem, its choice of the prior against draws from the prior."""

from __future__ import annotations

import numpy as np
import pytest

from udccal.cfa import PATTERNS, Cfa
from udccal.restoration.filter_tables import FilterTables, _tables_of, filter_tables
from udccal.restoration.kernel_grid import KernelGrid
from udccal.restoration.mosaic_filter import filtered
from udccal.restoration.scene_prior import COLOURS, prior_density
from udccal.restoration.tiles import TileLayout, layout_for

SIZE = 32


def kernels(rng: np.random.Generator) -> np.ndarray:
    drawn = rng.random((3, 9, 5)) ** 6
    return drawn / drawn.sum(axis=(1, 2), keepdims=True)


def circulant(kernel_spectrum: np.ndarray) -> np.ndarray:
    """Matrix of a periodic convolution from its transfer function."""
    columns = [
        np.fft.ifft2(kernel_spectrum * np.fft.fft2(np.eye(SIZE * SIZE)[i].reshape(SIZE, SIZE))).real.ravel()
        for i in range(SIZE * SIZE)
    ]
    return np.stack(columns, axis=1)


def dense_solution(tile: np.ndarray, kernel: np.ndarray, cfa: Cfa, strength: float) -> np.ndarray:
    density = circulant(prior_density(SIZE, SIZE)) * strength
    placed = np.zeros((3, SIZE, SIZE))
    placed[:, :9, :5] = kernel
    placed = np.roll(placed, (-4, -2), axis=(1, 2))
    blurs = [circulant(np.fft.fft2(p)) for p in placed]
    channels = cfa.channel_map(SIZE, SIZE).ravel()
    seen = np.zeros((SIZE * SIZE, SIZE * SIZE))
    mixed = COLOURS
    across = [np.zeros((SIZE * SIZE, SIZE * SIZE)) for _ in range(3)]
    for i in range(3):
        for j in range(3):
            block = density @ blurs[j].T
            across[i][:, channels == j] = mixed[i, j] * block[:, channels == j]
    for i in range(3):
        seen[channels == i] = (blurs[i] @ across[i])[channels == i]
    weights = np.linalg.solve(seen + np.eye(SIZE * SIZE), tile.ravel())
    return np.stack([(a @ weights).reshape(SIZE, SIZE) for a in across])


@pytest.mark.parametrize("name", ["RGGB", "GBRG", "mono"])
def test_the_filter_is_the_posteriors_mean(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    cfa, rng = PATTERNS[name], np.random.default_rng(5)
    kernel, strength = kernels(rng), 4.0
    tile = rng.normal(size=(SIZE, SIZE)).astype(np.float32)
    for channel in range(3):
        own = cfa.channel_map(SIZE, SIZE) == channel
        if own.any():
            tile[own] -= tile[own].mean()
    tables = FilterTables(*(table[None] for table in _tables_of(kernel, prior_density(SIZE, SIZE), cfa)))
    layout = TileLayout(SIZE, SIZE, 0, SIZE, SIZE, SIZE, cfa.rows, cfa.columns)
    monkeypatch.setattr(TileLayout, "taper", np.ones((SIZE, SIZE), np.float32))
    unit, given = np.ones((1, 3), np.float32), np.array([strength], np.float32)
    found, chosen = filtered(tile[None], unit, tables, layout, cfa, given)
    expected = dense_solution(tile.astype(float), kernel, cfa, strength)
    assert float(chosen[0]) == strength
    # In sigma of a sample's noise: single precision costs most at the tile's mean, where the prior is widest.
    # A level per site in place of one per colour gives 8e-3.
    np.testing.assert_allclose(np.moveaxis(found[0], -1, 0), expected, atol=6e-3)


def test_it_tells_the_source_point_from_the_mirrored_kernel() -> None:
    cfa, rng = PATTERNS["RGGB"], np.random.default_rng(6)
    kernel = kernels(rng)
    expected = dense_solution(rng.normal(size=(SIZE, SIZE)), kernel, cfa, 4.0)
    mirrored = dense_solution(np.random.default_rng(6).normal(size=(SIZE, SIZE)), kernel[:, ::-1, ::-1], cfa, 4.0)
    assert np.abs(expected - mirrored).max() > 0.1 * np.abs(expected).max()


@pytest.mark.parametrize("strength", [1.0, 64.0, 4096.0])
def test_scenes_drawn_from_the_prior_choose_their_own_strength(strength: float) -> None:
    cfa, rng = PATTERNS["RGGB"], np.random.default_rng(7)
    point = np.zeros((1, 1, 3, 3, 3), np.float32)
    point[..., 1, 1] = 1.0
    layout = layout_for(128, 128, (2, 2), (128, 128), (40, 80))
    shape = layout.rows, layout.columns
    tables = filter_tables(KernelGrid(np.zeros(1), np.zeros(1), point), layout, cfa, 1)
    amplitude = np.sqrt(strength * prior_density(*shape))
    grey = np.linalg.cholesky(COLOURS)
    white = np.fft.fft2(rng.normal(size=(layout.count, 3, *shape)))
    scene = np.einsum("ij,njyx->niyx", grey, np.fft.ifft2(white * amplitude).real)
    own = cfa.channel_map(*shape)
    mosaics = np.take_along_axis(scene, own[None, None], axis=1)[:, 0] + rng.normal(size=(layout.count, *shape))
    noise = np.ones((layout.count, 3), np.float32)
    _, chosen = filtered(mosaics.astype(np.float32), noise, tables, layout, cfa)
    assert np.all(np.abs(np.log2(chosen / strength)) <= 1.01)
    # Twice the signal and twice the noise is the same tile.
    _, again = filtered(2 * mosaics.astype(np.float32), 2 * noise, tables, layout, cfa)
    np.testing.assert_array_equal(chosen, again)
