"""Linear operators of restoration against their adjoints, <A x, y> = <x, A* y>, and the light that kernels keep."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import fft

from udccal.cfa import Cfa, cfa_named
from udccal.restoration.demosaic import demosaic
from udccal.restoration.filter_tables import FilterTables, filter_tables
from udccal.restoration.kernel_grid import KernelGrid, centred, interpolated_kernels
from udccal.restoration.scene_prior import prior_density
from udccal.restoration.site_planes import joined_planes, plane_spectra
from udccal.restoration.tiles import TileLayout

SIZE = 128
LAYOUT = TileLayout(SIZE, SIZE, 40, 80, SIZE, 40, 2, 2)


@pytest.fixture(scope="module", params=["RGGB", "GBRG"])
def cfa(request: pytest.FixtureRequest) -> Cfa:
    return cfa_named(request.param)


@pytest.fixture(scope="module")
def tables(toy_grid: KernelGrid, cfa: Cfa) -> FilterTables:
    return filter_tables(toy_grid, LAYOUT, cfa, 1).at(0)


def back(matched: np.ndarray, mosaic: np.ndarray, sites: list[int]) -> np.ndarray:
    """The prior times the adjoint of blur and sampling, of the samples of some sites, as the filter applies it."""
    spectra = plane_spectra(mosaic.astype(np.float32), (2, 2))
    mixed = np.sum(matched[:, sites] * spectra[sites], axis=1)
    return joined_planes(mixed[None].astype(np.complex64), (2, 2), SIZE)[0]


def products(tables: FilterTables, grid: KernelGrid, cfa: Cfa, colour: int) -> tuple[float, float]:
    """<A S x, y> by blur and sampling, and <x, S A* y> by the filter's tables; x and y are white noise."""
    rng = np.random.default_rng(6)
    x, y = rng.standard_normal((2, SIZE, SIZE))
    kernel = centred(interpolated_kernels(grid, LAYOUT.centres_px[:1])[0, colour], SIZE, SIZE)
    blurred = fft.ifft2(prior_density(SIZE, SIZE) * fft.fft2(kernel) * fft.fft2(x)).real
    own = cfa.channel_map(SIZE, SIZE) == colour
    sites = [index for index, site in enumerate(cfa.sites) if site.channel == colour]
    return float(np.sum(blurred[own] * y[own])), float(np.sum(x * back(tables.matched, y, sites)))


@pytest.mark.parametrize("colour", range(3))
def test_the_matched_filter_is_the_adjoint_of_the_camera(
    tables: FilterTables, toy_grid: KernelGrid, cfa: Cfa, colour: int
) -> None:
    forward, adjoint = products(tables, toy_grid, cfa, colour)
    assert adjoint == pytest.approx(forward, rel=1e-4, abs=1e-3 * SIZE)
    # Kernels that are turned round have another adjoint.
    turned = KernelGrid(toy_grid.x_px, toy_grid.y_px, np.roll(toy_grid.kernels, 3, axis=-2))
    forward, adjoint = products(tables, turned, cfa, colour)
    assert adjoint != pytest.approx(forward, rel=1e-4, abs=1e-3 * SIZE)


def test_eigenvectors_are_orthonormal(tables: FilterTables) -> None:
    """So their conjugates, by which the filter goes back, are their adjoint and their inverse."""
    product = np.einsum("ksyx,kpyx->yxsp", np.conj(tables.vectors), tables.vectors)
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(4), product.shape), atol=1e-5)


@pytest.mark.parametrize("cell", [(1, 1), (2, 2), (1, 2), (2, 1)])
def test_transforms_of_planes_keep_products_and_come_back(cell: tuple[int, int]) -> None:
    rows, columns = 24, 36
    x, y = np.random.default_rng(7).standard_normal((2, rows, columns)).astype(np.float32)
    of_x, of_y = plane_spectra(x, cell), plane_spectra(y, cell)
    across = columns // cell[1]
    # Other frequencies of a row are conjugates of the half that is there.
    weights = np.full(across // 2 + 1, 2.0)
    weights[0] = 1.0
    if across % 2 == 0:
        weights[-1] = 1.0
    found = np.sum((of_x * np.conj(of_y)).real * weights) / (rows // cell[0] * across)
    assert found == pytest.approx(float(np.sum(x * y)), rel=1e-4, abs=1e-3)
    np.testing.assert_allclose(joined_planes(of_x[None], cell, columns)[0], x, atol=1e-5)


def test_kernels_keep_all_light_between_their_nodes(toy_grid: KernelGrid) -> None:
    places = np.random.default_rng(8).uniform(-20, 150, (40, 2)).astype(np.float32)
    kernels = interpolated_kernels(toy_grid, places)
    np.testing.assert_allclose(kernels.sum(axis=(2, 3)), 1.0, atol=1e-5)
    # One that is larger than a tile wraps round, and loses nothing.
    assert centred(kernels[0, 1], 16, 8).sum() == pytest.approx(1.0, abs=1e-5)
    assert centred(kernels[0, 1][:-9], 16, 8).sum() != pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize("detail", [1.0, 0.65, 0.0])
def test_demosaicing_keeps_all_light(detail: float) -> None:
    np.testing.assert_allclose(demosaic(np.full((12, 14), 3.0, np.float32), "GRBG", detail), 3.0, rtol=1e-6)
