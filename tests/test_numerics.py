"""How fits compute: double precision and BLAS on one thread, and neither of them afterwards."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from threadpoolctl import ThreadpoolController, threadpool_limits

from udccal.numerics import in_float64


def blas_threads() -> set[int]:
    np.linalg.inv(np.eye(2))  # it is loaded by now
    return {library["num_threads"] for library in ThreadpoolController().select(user_api="blas").info()}


@in_float64
def inner() -> tuple[set[int], str]:
    return blas_threads(), str(jnp.zeros(1).dtype)


@in_float64
def outer() -> tuple[set[int], str]:
    inner()
    return blas_threads(), str(jnp.zeros(1).dtype)


@in_float64
def failing() -> None:
    raise ValueError("on the way")


def test_a_fit_computes_in_double_precision_on_one_thread_and_leaves_no_trace() -> None:
    with threadpool_limits(2, user_api="blas"):
        assert outer() == ({1}, "float64")
        assert blas_threads() == {2}
        with pytest.raises(ValueError, match="on the way"):
            failing()
        assert blas_threads() == {2}
    assert jnp.zeros(1).dtype == jnp.float32
