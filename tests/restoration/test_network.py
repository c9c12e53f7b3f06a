from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from udccal.restoration.network import (
    BANDS,
    COLOURS,
    corrected,
    correction,
    details,
    network_weights,
    noise_planes,
    shapes,
)
from udccal.restoration.tiles import layout_for


def inputs(rows: int, columns: int, seed: int = 0) -> tuple[np.ndarray, ...]:
    """A picture of edges and noise at three stages, its noise's scale and bands."""
    rng = np.random.default_rng(seed)
    edges = 40.0 * (np.add.outer(np.arange(rows) // 9, np.arange(columns) // 13) % 3)[..., None]
    pictures = [
        (edges + sigma * rng.standard_normal((rows, columns, COLOURS))).astype(np.float32) for sigma in (1, 3, 8)
    ]
    scale = np.full((rows, columns, COLOURS), 5.0, np.float32)
    noise = rng.uniform(0.1, 0.5, (-(-rows // 2), -(-columns // 2), BANDS)).astype(np.float32)
    return *pictures, scale, noise


def test_the_shipped_weights_are_those_of_the_network() -> None:
    weights = network_weights()
    assert {name: weight.shape for name, weight in weights.items()} == shapes()
    assert all(np.all(np.isfinite(weight)) for weight in weights.values())


@pytest.mark.parametrize("factor", [1e-3, 7.0, 1e5])
def test_light_does_not_matter_to_the_network(factor: float) -> None:
    balanced, chosen, sharper, scale, noise = inputs(64, 80)
    found = corrected(balanced, chosen, sharper, scale, noise, 1)
    of = np.float32(factor)
    brighter = corrected(of * balanced, of * chosen, of * sharper, of * scale, noise, 1)
    np.testing.assert_allclose(brighter, of * found, rtol=1e-4, atol=factor * 1e-3)
    assert np.abs(found - balanced).max() > 0.1


def test_a_colour_is_not_taken_for_another() -> None:
    balanced, chosen, sharper, scale, noise = inputs(64, 80)
    grey = corrected(balanced, chosen, sharper, scale, noise, 1)
    swapped = corrected(*(np.ascontiguousarray(p[..., ::-1]) for p in (balanced, chosen, sharper, scale)), noise, 1)
    assert np.abs(swapped[..., ::-1] - grey).max() > 1e-3


def test_blocks_leave_no_seams() -> None:
    given = inputs(400, 176)
    *pictures, scale, noise = given
    detail = jnp.asarray(details(*pictures, scale))[None]
    direct = pictures[0] + scale * np.asarray(correction(network_weights(), detail, jnp.asarray(noise)[None]))[0]
    inner = np.s_[64:-64, 64:-64]
    np.testing.assert_allclose(corrected(*given, 1)[inner], direct[inner], atol=2e-3)


def test_seen_four_ways_round_no_way_counts_more() -> None:
    """Pictures of whole cells: others are padded at their end, whichever that is."""
    *pictures, scale, noise = inputs(128, 160)
    for down, across in ((-1, 1), (1, -1)):
        turned = [np.ascontiguousarray(planes[::down, ::across]) for planes in (*pictures, scale, noise)]
        for views, tolerance in ((4, 2e-3), (1, None)):
            found = corrected(*pictures, scale, noise, views)
            off = np.abs(corrected(*turned, views)[::down, ::across] - found)[48:-48, 48:-48].max()
            assert off < tolerance if tolerance else off > 0.05


@pytest.mark.parametrize("size", [(1, 1), (3, 5), (37, 51), (258, 2)])
def test_odd_sizes(size: tuple[int, int]) -> None:
    found = corrected(*inputs(*size), 4)
    assert found.shape == (*size, COLOURS)
    assert np.all(np.isfinite(found))


def test_noise_planes_follow_light_and_bands() -> None:
    layout = layout_for(160, 224, (2, 2), (128, 128), (0, 160))
    variance = np.full((layout.count, 3, 4, 3), 0.25, np.float32)
    noise_e = np.full((layout.count, 3), 10.0, np.float32)
    local = np.full((160, 224), 100.0, np.float32)
    local[:, 112:] = 900.0
    found = noise_planes(variance, noise_e, local, layout)
    assert found.shape == (80, 112, BANDS)
    np.testing.assert_allclose(found[:, :56], 0.5, rtol=1e-5)
    np.testing.assert_allclose(found[:, 56:], 1.5, rtol=1e-5)
