"""Run fits in double precision, without changing the importing program's JAX settings, and with BLAS on one thread."""

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
    """Wrap ``function`` so that 64-bit JAX types are enabled, and BLAS uses one thread, during each call only.

    The function should return numpy arrays, not JAX arrays: outside the context the next operation would narrow a
    64-bit JAX array.
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
    """Keep BLAS from splitting the small matrices of fits among threads.

    Its threads spin while they wait for each other. A factorisation takes ten times as long when another program uses a
    core, and gains little when none does.
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
