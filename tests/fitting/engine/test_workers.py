from __future__ import annotations

import threading

import jax.numpy as jnp
import numpy as np
import pytest

from udccal.fitting.engine.workers import beside, each


def test_results_come_in_the_order_of_the_parts_in_double_precision() -> None:
    found = each(lambda part: np.asarray(jnp.sqrt(jnp.float64(part))), range(40))
    assert [one.dtype for one in found] == [np.float64] * 40
    assert [float(one) for one in found] == [np.sqrt(part) for part in range(40)]


def test_the_first_part_is_done_before_others_begin() -> None:
    done: list[int] = []

    def part(number: int) -> int:
        assert number == 0 or 0 in done
        done.append(number)
        return number

    assert each(part, range(20)) == list(range(20))
    assert each(part, [0]) == [0]


def test_two_threads_share_the_parts() -> None:
    both = threading.Barrier(2)
    # Each of two parts waits for the other: one thread alone would wait for ever.
    each(lambda number: number and both.wait(timeout=20), range(3))


def test_an_error_of_a_part_is_raised() -> None:
    with pytest.raises(ZeroDivisionError):
        each(lambda number: 1 / (number - 3), range(6))


def test_what_is_called_beside_a_block_runs_in_double_precision_and_may_fail() -> None:
    kinds: list[str] = []
    with beside(lambda: 1 / 0, lambda: kinds.append(str(jnp.ones(1).dtype))):
        pass
    assert kinds == ["float64"]
