"""How fits compute: double precision and BLAS on one thread, neither of them afterwards, and parts in two threads."""

from __future__ import annotations

import multiprocessing
import threading

import jax.numpy as jnp
import numpy as np
import pytest
from threadpoolctl import ThreadpoolController, threadpool_limits

from udccal.numerics import in_float64, in_two_threads


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


def test_results_come_in_the_order_of_the_parts_in_double_precision() -> None:
    found = in_two_threads(lambda part: np.asarray(jnp.sqrt(jnp.float64(part))), range(40))
    assert [one.dtype for one in found] == [np.float64] * 40
    assert [float(one) for one in found] == [np.sqrt(part) for part in range(40)]


def test_the_first_part_is_done_before_others_begin() -> None:
    done: list[int] = []

    def part(number: int) -> int:
        assert number == 0 or 0 in done
        done.append(number)
        return number

    assert in_two_threads(part, range(20)) == list(range(20))
    assert in_two_threads(part, [0]) == [0]


def test_two_threads_share_the_parts() -> None:
    both = threading.Barrier(2)
    # Each of two parts waits for the other: one thread alone would wait for ever.
    in_two_threads(lambda number: number and both.wait(timeout=20), range(3))


def test_an_error_of_a_part_is_raised() -> None:
    with pytest.raises(ZeroDivisionError):
        in_two_threads(lambda number: 1 / (number - 3), range(6))


@pytest.mark.timeout(60)
def test_parts_within_parts_wait_for_no_thread() -> None:
    def row(number: int) -> list[int]:
        return in_two_threads(lambda other: number * other, range(4))

    assert in_two_threads(row, range(6)) == [[number * other for other in range(4)] for number in range(6)]


def tens() -> None:
    assert in_two_threads(lambda number: 10 * number, range(4)) == [0, 10, 20, 30]


@pytest.mark.filterwarnings("ignore:.*fork")
def test_a_forked_process_has_threads_of_its_own() -> None:
    tens()
    child = multiprocessing.get_context("fork").Process(target=tens)
    child.start()
    child.join(30)
    assert child.exitcode == 0
