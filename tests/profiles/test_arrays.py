from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays_of

from udccal.errors import ProfileError
from udccal.profiles import arrays


@pytest.mark.parametrize(
    "array",
    [
        np.random.default_rng(0).normal(size=(7, 5, 3)) * 10.0 ** np.arange(-6, 9).reshape(5, 3),
        np.random.default_rng(1).normal(size=(40, 30)).astype(np.float32),
        np.arange(-600, 600, dtype=np.int64).reshape(30, 40) * 2**40,
        np.random.default_rng(2).integers(0, 256, (3, 20, 20)).astype(np.uint8),
        np.random.default_rng(3).random((5, 4)) > 0.5,
        np.array(np.pi),
    ],
)
def test_arrays_come_back_bit_for_bit(tmp_path: Path, array: np.ndarray) -> None:
    back = arrays.load(tmp_path, arrays.store(tmp_path, "a.exr", "a", array, "1"))
    assert (back.dtype, back.shape) == (array.dtype, array.shape)
    np.testing.assert_array_equal(back, array)


@given(arrays_of.arrays(np.float64, (3, 2), elements=st.floats(-1e300, 1e300)))
def test_small_arrays_come_back_bit_for_bit(array: np.ndarray) -> None:
    stored = arrays.inline("a", array, "px", None)
    back = arrays.from_inline(type(stored).model_validate_json(stored.model_dump_json(), strict=True))
    np.testing.assert_array_equal(back, array)


def test_numbers_that_are_none_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ProfileError, match="finite values of 'a'"):
        arrays.store(tmp_path, "a.exr", "a", np.array([[1.0, np.inf]]), "1")
    with pytest.raises(ProfileError, match="complex128"):
        arrays.inline("a", np.array([1j]), "1", None)
    assert list(tmp_path.iterdir()) == []
