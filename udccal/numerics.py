"""How fits compute: in double precision whatever the program has set JAX to, BLAS on one thread, parts in two."""

from __future__ import annotations

import contextlib
import functools
import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextvars import ContextVar, copy_context
from typing import ParamSpec, TypeVar

import jax
from threadpoolctl import ThreadpoolController

P = ParamSpec("P")
T = TypeVar("T")
Part = TypeVar("Part")


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


_WITHIN: ContextVar[bool] = ContextVar("within_two_threads", default=False)


def in_two_threads(function: Callable[[Part], T], parts: Iterable[Part]) -> list[T]:
    """Results of a function of every part, in order, in double precision, by two threads.

    Compiled functions and loops of numpy let the other thread run. The first part is alone, so that what it compiles is
    compiled once. More threads would need more memory, and most of them would wait for the interpreter. Within one of
    the two threads, parts follow each other.

    Args:
        function: returns numpy arrays; it must not change what parts have in common.
        parts: at least one.
    """
    made, (first, *others) = in_float64(function), parts
    found = made(first)
    if _WITHIN.get():
        return [found, *map(made, others)]
    before = _WITHIN.set(True)
    # The threads know by their context that BLAS is limited already: to limit it takes as long as a small part.
    contexts = [copy_context() for _ in others]
    _WITHIN.reset(before)
    return [found, *_pool().map(lambda context, part: context.run(made, part), contexts, others)]


@functools.cache
def _pool() -> ThreadPoolExecutor:
    """Return the same two threads in every call: the C library keeps memory that each new thread has freed."""
    return ThreadPoolExecutor(2)


# A forked process has none of its parent's threads.
os.register_at_fork(after_in_child=_pool.cache_clear)
