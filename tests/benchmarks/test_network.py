from __future__ import annotations

from pathlib import Path

import cv2
import jax.numpy as jnp
import numpy as np
import pytest

from tests.benchmarks.network.examples import INNER_PX, PATCH_PX, Examples, Optics, patch
from tests.benchmarks.network.pictures import drawn_picture, files, photographs
from udccal.restoration.network import correction, shapes


def streak() -> np.ndarray:
    """One kernel of all colours: a peak and orders above and below it."""
    kernel = np.zeros((41, 5), np.float32)
    kernel[20, 2], kernel[10, 2], kernel[30, 2] = 0.6, 0.2, 0.2
    return np.repeat(kernel[None], 3, axis=0)


@pytest.fixture(scope="module")
def examples() -> Examples:
    """One kernel for every pattern, and one picture beside those that are drawn."""
    picture = drawn_picture(640, np.random.default_rng(7))
    return Examples([Optics.of(streak(), turn) for turn in range(6)], [picture], seed=1)


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


def test_pictures_are_found_and_some_are_held_out(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="Debian's package mate-backgrounds"):
        photographs(tmp_path, tmp_path, np.random.default_rng(0))
    for file in files(tmp_path).values():
        if file.is_relative_to(tmp_path):
            file.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(file), np.random.default_rng(1).integers(0, 255, (300, 1700, 3)).astype(np.uint8))
    own, judging = photographs(tmp_path, tmp_path, np.random.default_rng(0))
    assert len(own) + len(judging) == len(files(tmp_path))
    assert len(own) >= 14
    assert len(judging) == 7
    assert all(p.ndim == 3 and p.min() >= 0 and p.max() <= 4 and max(p.shape) < 1600 for p in own + judging)


def test_the_network_that_trains_is_the_one_that_restores() -> None:
    torch = pytest.importorskip("torch", reason="pip install 'udccal[train]'")
    from tests.benchmarks.network.torch_network import Network, to_weights

    rng = np.random.default_rng(3)
    smaller = {name: rng.standard_normal(small(shape)).astype(np.float32) for name, shape in shapes().items()}
    given = [jnp.asarray(rng.standard_normal(shape), jnp.float32) for shape in ((1, 16, 24, 9), (1, 8, 12, 12))]
    planes = [torch.tensor(np.asarray(part).transpose(0, 3, 1, 2)) for part in given]
    drawn, larger = Network(rng), Network(rng, smaller)
    with torch.no_grad():
        # It begins without a correction.
        assert not drawn(*planes).numpy().any()
        drawn.kernels["out"].normal_()
    of_smaller = {name: jnp.asarray(kernel) for name, kernel in smaller.items()}
    for network, weights in ((drawn, to_weights(drawn)), (larger, to_weights(larger)), (larger, of_smaller)):
        expected = np.asarray(correction(weights, *given))
        found = network(*planes).detach().numpy().transpose(0, 2, 3, 1)
        np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())


def small(shape: tuple[int, ...]) -> tuple[int, ...]:
    """A kernel with three quarters of the channels of both levels."""
    rows, columns, *channels = shape
    return rows, columns, *(count if count % 32 else count * 3 // 4 for count in channels)
