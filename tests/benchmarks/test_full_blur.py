"""Points of light through the full blur, against the simulator's own kernels."""

from __future__ import annotations

import numpy as np
import pytest

from tests.benchmarks.budget import true_kernels
from tests.benchmarks.full_blur import FullBlur, build_full_blur
from tests.simulation.toy import toy_truth
from udccal.simulation.blur import SpaceVariantBlur, build_blur
from udccal.simulation.psf import kernels
from udccal.simulation.truth import RigTruth

_WINDOW = (33, 17)
_PLACES = np.array([[40.0, 30.0], [64.0, 36.0], [77.0, 51.0], [90.0, 66.0]])


def _worst_error(truth: RigTruth, blur: FullBlur | SpaceVariantBlur) -> float:
    """Relative L2 over places between the grid's nodes."""
    down, across = blur.margin
    found = []
    for (x, y), kernel in zip(_PLACES.astype(int), kernels(truth, _PLACES, *_WINDOW), strict=True):
        canvas = np.zeros((96 + 2 * down, 128 + 2 * across, 3))
        canvas[down + y, across + x] = 1.0
        seen = blur.apply(canvas)[y - down : y + down + 1, x - across : x + across + 1]
        error = np.moveaxis(seen, -1, 0) - kernel
        found.append(np.sqrt((error**2).sum(axis=(1, 2)) / (kernel**2).sum(axis=(1, 2))).max())
    return float(max(found))


@pytest.mark.medium
def test_points_have_the_simulators_kernels_interference_included() -> None:
    truth = toy_truth()
    full = _worst_error(truth, build_full_blur(truth, 3, 3, *_WINDOW))
    assert full < 4e-3
    # The blur without interference does not pass.
    assert _worst_error(truth, build_blur(truth, 3, 3, *_WINDOW)) > 2 * full


@pytest.mark.medium
def test_the_kernels_of_the_budget_are_the_blurs_own_at_its_nodes() -> None:
    truth = toy_truth()
    grid = true_kernels(build_full_blur(truth, 3, 3, *_WINDOW))
    assert grid.kernels.shape == (3, 3, 3, *_WINDOW)
    node = np.array([[grid.x_px[1], grid.y_px[2]]])
    kernel = kernels(truth, node, *_WINDOW)[0]
    off = grid.kernels[2, 1] - kernel / kernel.sum(axis=(1, 2), keepdims=True)
    # Interference changes a kernel by a percent, other nodes by more.
    assert np.sqrt((off**2).sum() / (kernel**2).sum()) < 0.02
