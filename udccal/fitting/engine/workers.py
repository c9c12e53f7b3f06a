"""Threads of a fit: its independent parts in two of them, and compiling beside other work."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import copy_context
from typing import TypeVar

from udccal.numerics import in_float64

Part = TypeVar("Part")
Result = TypeVar("Result")
# More would need more memory, and most of them would wait for the interpreter.
_THREADS = 2


def each(function: Callable[[Part], Result], parts: Iterable[Part]) -> list[Result]:
    """Results of a function of every part, in order, in double precision.

    Compiled functions and loops of numpy let other threads run. The first part is alone, so that what it compiles is
    compiled once.

    Args:
        function: returns numpy arrays; it must not change what parts have in common.
        parts: at least one.
    """
    made, (first, *others) = in_float64(function), parts
    found = made(first)
    if not others:
        return [found]
    # The threads know by their context that BLAS is limited already: to limit it takes as long as a small part.
    contexts = [copy_context() for _ in others]
    with ThreadPoolExecutor(_THREADS) as pool:
        return [found, *pool.map(lambda context, part: context.run(made, part), contexts, others)]


@contextmanager
def beside(*functions: Callable[[], object]) -> Iterator[None]:
    """Call functions one after the other in a thread of their own, in double precision, while a block runs.

    They compile what is needed after the block: their results, and what they raise, are dropped.
    """
    with ThreadPoolExecutor(1) as pool:
        for function in functions:
            pool.submit(in_float64(function))
        yield
