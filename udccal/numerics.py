"""How fits compute: in double precision, without switching the importing program's JAX to it, each on one thread."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from typing import ParamSpec, TypeVar

import jax
from threadpoolctl import ThreadpoolController

P = ParamSpec("P")
T = TypeVar("T")


def in_float64(function: Callable[P, T]) -> Callable[P, T]:
    """Run ``function`` with 64-bit JAX types enabled for the length of the call only, and BLAS on one thread.

    Return numpy arrays (not JAX arrays) from a function so wrapped: a 64-bit JAX array outside the context would be
    narrowed by the next operation on it.
    """

    @functools.wraps(function)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> T:
        with jax.enable_x64(True), _one_blas_thread():
            return function(*args, **kwargs)

    return wrapped


_ALREADY: ContextVar[bool] = ContextVar("blas_on_one_thread", default=False)


@functools.cache
def _libraries() -> ThreadpoolController:
    return ThreadpoolController()


@contextlib.contextmanager
def _one_blas_thread() -> Iterator[None]:
    """Keep BLAS from sharing out the small matrices of fits.

    Its threads wait for each other by turning in circles: where another program uses a core, a factorisation takes ten
    times as long, and little is gained where none does.
    """
    if _ALREADY.get():
        yield
        return
    before = _ALREADY.set(True)
    try:
        with _libraries().limit(limits=1, user_api="blas"):
            yield
    finally:
        _ALREADY.reset(before)
