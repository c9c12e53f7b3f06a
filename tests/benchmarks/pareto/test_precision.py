from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.benchmarks.pareto.precision import Kind, Loss, Storage, cheapest, in_double, rounded
from udccal.restoration.filter_tables import FilterTables
from udccal.restoration.kernel_grid import KernelGrid
from udccal.restoration.plan import PlanOptions
from udccal.restoration.runtime import SceneLight
from udccal.restoration.sharpen import Sharpener
from udccal.rig import load_rig
from udccal.tiers import Tier

ROWS, COLUMNS = 128, 192


@pytest.fixture(scope="module")
def sharpener() -> Sharpener:
    """Kernels of three taps, of other weights for each colour and place."""
    rig = load_rig("lg55-reduced")
    camera = rig.camera.model_copy(update={"rows": ROWS, "columns": COLUMNS})
    weights = np.random.default_rng(1).uniform(0.1, 0.4, (2, 2, 3, 1, 1))
    kernels = np.concatenate([weights, 1 - 2 * weights, weights], axis=3)
    grid = KernelGrid(np.array([0.0, COLUMNS - 1.0]), np.array([0.0, ROWS - 1.0]), kernels.astype(np.float32))
    options = PlanOptions(tile_rows=128, tile_columns=128, workers=1)
    return Sharpener.of(grid, rig.model_copy(update={"camera": camera}), (0, ROWS), Tier.fast, options)


@pytest.fixture(scope="module")
def light() -> SceneLight:
    y, x = np.mgrid[:ROWS, :COLUMNS]
    expected = 3000 + 2000 * np.sin(x / 5) * np.cos(y / 7)
    signal = np.random.default_rng(2).poisson(expected).astype(np.float32)
    return SceneLight(signal, expected.astype(np.float32), np.zeros(signal.shape, bool), None, None)


def test_the_filter_in_double_precision_is_the_same_filter(sharpener: Sharpener, light: SceneLight) -> None:
    solved = sharpener.solved(light.signal_e, light.variance_e2, light.clipped)
    double = sharpener.layout.join(in_double(sharpener, light, solved))
    # Single precision rounds to some 1 e- of 3000 here: much cancels in the sum over sites. The noise is 55 e-.
    assert np.abs(double - solved.picture).max() < 2


def test_a_filter_of_other_strength_is_told_from_it(sharpener: Sharpener, light: SceneLight) -> None:
    solved = sharpener.solved(light.signal_e, light.variance_e2, light.clipped)
    weaker = replace(solved, strengths=solved.strengths / np.float32(2))
    double = sharpener.layout.join(in_double(sharpener, light, weaker))
    assert np.abs(double - solved.picture).max() > 5


def test_numbers_are_rounded_as_their_kind_stores_them() -> None:
    numbers = np.array([1.0, 1 + 2.0**-9, 1 + 2.0**-12, 3e38, 1e-30], np.float32)
    assert rounded(numbers, Kind.float32) is numbers
    assert rounded(numbers, Kind.bfloat16)[:3].tolist() == [1.0, 1.0, 1.0]
    assert np.all(np.abs(rounded(numbers, Kind.bfloat16) / numbers - 1) < 2.0**-8)
    half = rounded(numbers, Kind.float16)
    assert np.isfinite(half).all()
    assert half[0] == 0.0  # below the range beside 3e38
    assert rounded(numbers[:3], Kind.float16).tolist() == [1.0, 1 + 2.0**-9, 1.0]


def test_complex_numbers_are_rounded_in_both_parts() -> None:
    assert rounded(np.array([1 + 2.0**-9 + (1 + 2.0**-9) * 1j], np.complex64), Kind.bfloat16)[0] == 1 + 1j


def test_the_cheapest_precision_loses_next_to_nothing_on_every_scene() -> None:
    losses = [
        Loss("float32", (0.0, 0.0), 32.0),
        Loss("good", (0.01, 0.04), 16.0),
        Loss("one bad scene", (-0.1, 0.06), 8.0),
        Loss("broken", (0.0, float("nan")), 4.0),
    ]
    assert cheapest(losses).name == "good"
    with pytest.raises(ValueError, match="found none"):
        cheapest(losses[2:])


def test_storages_have_names_and_sizes() -> None:
    tables = FilterTables(
        np.zeros((4, 4, 8, 8), np.complex64), np.zeros((4, 4, 8, 8), np.complex64), np.zeros((4, 8, 8), np.float32)
    )
    whole, half = Storage(), Storage(*[Kind.float16] * 3)
    assert half.mebibytes(tables) == whole.mebibytes(tables) / 2
    names = [whole.name, half.name, Storage(values=Kind.bfloat16).name]
    assert names == ["tables in float32", "all tables in float16", "values in bfloat16"]
