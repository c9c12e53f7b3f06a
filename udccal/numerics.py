"""Double precision for fits, without switching the importing program's JAX to it."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import jax

P = ParamSpec("P")
T = TypeVar("T")


def in_float64(function: Callable[P, T]) -> Callable[P, T]:
    """Run ``function`` with 64-bit JAX types enabled for the length of the call only.

    Return numpy arrays (not JAX arrays) from a function so wrapped: a 64-bit JAX array outside the context would be
    narrowed by the next operation on it.
    """

    @functools.wraps(function)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> T:
        with jax.enable_x64(True):
            return function(*args, **kwargs)

    return wrapped
