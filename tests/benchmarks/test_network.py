from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.benchmarks.network.examples import INNER_PX, Examples, Optics
from tests.benchmarks.network.pictures import drawn_picture
from tests.benchmarks.network.train import PATCH_PX, patch


def streak() -> np.ndarray:
    """One kernel of all colours: a peak and orders above and below it."""
    kernel = np.zeros((41, 5), np.float32)
    kernel[20, 2], kernel[10, 2], kernel[30, 2] = 0.6, 0.2, 0.2
    return np.repeat(kernel[None], 3, axis=0)


@pytest.fixture(scope="module")
def examples(tmp_path_factory: pytest.TempPathFactory) -> Examples:
    """One kernel for every pattern; without the shared folder, so without panoramas."""
    return Examples([Optics.of(streak(), turn) for turn in range(6)], tmp_path_factory.mktemp("data"), seed=1)


def test_examples_are_of_the_sizes_that_training_cuts(examples: Examples) -> None:
    for _ in range(6):
        example = examples.draw()
        assert example.detail.shape == (INNER_PX, INNER_PX, 9)
        assert example.noise.shape == (INNER_PX // 2, INNER_PX // 2, 12)
        assert example.missing.shape == example.weight.shape == (INNER_PX, INNER_PX, 3)
        assert all(np.all(np.isfinite(part)) for part in vars(example).values())
        assert np.all(example.weight > 0)
        assert np.all(example.noise > 0)


def test_what_is_missing_lies_where_the_picture_does(examples: Examples) -> None:
    """The picture of the tier balanced and what it misses make the scene; shifted by a pixel, they would not."""
    better = 0
    for _ in range(8):
        example = examples.draw()
        found, missing = example.detail[..., :3], example.missing
        detail = found + missing  # of the scene, but for its mean over some px
        errors = [np.mean((np.roll(found, shift, (0, 1)) - detail) ** 2) for shift in ((0, 0), (0, 1), (1, 0))]
        better += int(np.argmin(errors) == 0)
    assert better >= 7


def test_a_patch_is_mirrored_as_one(examples: Examples) -> None:
    example = examples.draw()
    y, x = np.mgrid[:INNER_PX, :INNER_PX].astype(np.float32)
    place = np.stack([y, x], axis=-1)
    half = place[::2, ::2]
    seen = set()
    for seed in range(12):
        parts = patch((place, half, place, example.weight), np.random.default_rng(seed))
        assert parts[0].shape == (PATCH_PX, PATCH_PX, 2)
        assert parts[1].shape == (PATCH_PX // 2, PATCH_PX // 2, 2)
        np.testing.assert_array_equal(parts[0], parts[2])
        # A half-size sample lies in the middle of its four.
        middle = parts[0].reshape(PATCH_PX // 2, 2, PATCH_PX // 2, 2, 2).mean(axis=(1, 3))
        np.testing.assert_allclose(middle - parts[1], 0.5)
        seen.add((bool(parts[0][0, 0, 0] < parts[0][-1, 0, 0]), bool(parts[0][0, 0, 1] < parts[0][0, -1, 1])))
    assert len(seen) == 4


def test_drawn_pictures_have_edges_and_stay_in_range() -> None:
    pictures = [drawn_picture(96, np.random.default_rng(seed)) for seed in range(4)]
    for picture in pictures:
        assert picture.shape == (96, 96, 3)
        assert picture.min() > 0
        assert picture.max() < 3
        assert np.abs(np.diff(picture, axis=0)).max() > 0.02
    assert not np.array_equal(pictures[0], pictures[1])


def test_pictures_of_packages_are_found(tmp_path: Path) -> None:
    from tests.benchmarks.network.pictures import photographs

    found = photographs(tmp_path, np.random.default_rng(0))
    assert len(found) >= 14
    assert all(p.ndim == 3 and p.min() >= 0 and p.max() <= 4 for p in found)
