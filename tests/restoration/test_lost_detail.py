"""The expected loss against those of scenes drawn from the prior."""

from __future__ import annotations

import numpy as np

from udccal.cfa import cfa_named
from udccal.restoration.filter_tables import FilterTables, filter_tables
from udccal.restoration.kernel_grid import KernelGrid, centred
from udccal.restoration.lost_detail import lost_detail
from udccal.restoration.mosaic_filter import filtered
from udccal.restoration.scene_prior import COLOURS, STRENGTHS, prior_density
from udccal.restoration.tiles import TileLayout

SIZE, INDEX, DRAWS = 128, 10, 24


def test_lost_detail_is_that_of_draws() -> None:
    rng, cfa = np.random.default_rng(4), cfa_named("RGGB")
    kernel = np.zeros((3, 15, 5))
    kernel[:, ::4, 2] = np.array([0.15, 0.2, 0.4, 0.25])
    grid = KernelGrid(np.zeros(1), np.zeros(1), kernel[None, None])
    layout = TileLayout(SIZE, SIZE, 40, 80, SIZE, 40, 2, 2)
    tables = filter_tables(grid, layout, cfa, 1)
    one = FilterTables(*(table[:1] for table in (tables.matched, tables.vectors, tables.values)))
    expected = lost_detail(one, layout, cfa)
    strength = STRENGTHS[INDEX]
    root, mix = np.sqrt(strength * prior_density(SIZE, SIZE)), np.linalg.cholesky(COLOURS)
    transfer = np.fft.fft2(np.stack([centred(each, SIZE, SIZE) for each in kernel]))
    channels = cfa.channel_map(SIZE, SIZE)
    inner = tuple(slice(ends.taper + 8, -ends.taper - 8) for ends in (layout.down, layout.across))
    wrong, noise_alone = [], []
    for _ in range(DRAWS):
        white = np.fft.fft2(rng.standard_normal((3, SIZE, SIZE)))
        scene = np.fft.ifft2(np.tensordot(mix, white, 1) * root).real
        blurred = np.fft.ifft2(np.fft.fft2(scene) * transfer).real
        noise = rng.standard_normal((SIZE, SIZE))
        for mosaic, kept in ((np.take_along_axis(blurred, channels[None], 0)[0] + noise, wrong), (noise, noise_alone)):
            tile = mosaic.astype(np.float32)[None]
            unit = np.ones((1, 3), np.float32)
            found, _ = filtered(tile, unit, one, layout, cfa, np.array([strength], np.float32))
            truth = np.moveaxis(scene, 0, -1) if kept is wrong else 0.0
            kept.append(np.mean((found[0] - truth)[inner] ** 2, axis=(0, 1)))
    noise_variance, lost = np.mean(noise_alone, axis=0), expected.variance[0, INDEX]
    np.testing.assert_allclose(np.mean(wrong, axis=0), noise_variance + lost, rtol=0.1)
    assert (lost > 0.3 * noise_variance).all()
