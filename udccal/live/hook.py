"""A person's own function that alters restored frames, within a time limit."""

from __future__ import annotations

import contextlib
import importlib
import os
import queue
import sys
import threading
from collections.abc import Callable, Iterator
from typing import final

import numpy as np
from jaxtyping import UInt8

from udccal.arguments import check_number, found_instead
from udccal.errors import LiveError

Picture = UInt8[np.ndarray, "rows columns 3"]
# What a hook returns is checked.
Hook = Callable[[Picture, int], object]


def load_hook(text: str) -> Hook:
    """Import the function of ``module:function``; the module may lie in the present folder.

    Raises:
        LiveError: when there is none.
    """
    module, _, name = text.partition(":")
    try:
        with _importable(os.getcwd()):
            found = getattr(importlib.import_module(module), name)
    except (Exception, SystemExit) as error:  # whatever the module does when it is imported
        raise LiveError(
            f"Expected --hook module:function with a function that can be imported, found for '{text}': "
            f"{type(error).__name__}: {error}. Correct the name or the module, or start in the module's folder."
        ) from error
    if not callable(found):
        raise LiveError(f"Expected --hook '{text}' to name a function, found {type(found).__name__}. Name another.")
    function: Hook = found
    return function


@contextlib.contextmanager
def _importable(folder: str) -> Iterator[None]:
    """Have modules of a folder found meanwhile; what a module itself does to the path stays."""
    new = folder not in sys.path
    if new:
        sys.path.append(folder)
    try:
        yield
    finally:
        if new and folder in sys.path:
            sys.path.remove(folder)


@final
class TimedHook:
    """Calls a hook in a thread of its own, and goes on without its result where that is late.

    While a late call still runs, further frames go out unaltered, too: no call is begun before the last one ended.

    Args:
        function: gets a copy of the picture and the frame's number; returns a picture of the same size.
        limit_s: how long one call may take, at most a minute.

    Raises:
        LiveError: when the limit is no such time.
    """

    def __init__(self, function: Hook, limit_s: float) -> None:
        check_number(limit_s, "a hook's limit in s", (1e-4, 60.0), "Give 0.01 for 10 ms.", LiveError)
        self._function, self._limit_s = function, limit_s
        self._asked: queue.SimpleQueue[tuple[Picture, int]] = queue.SimpleQueue()
        self._answers: queue.SimpleQueue[object] = queue.SimpleQueue()
        self._running = False
        # A daemon, since a hook may never return.
        threading.Thread(target=self._work, name="hook", daemon=True).start()

    def apply(self, picture: Picture, frame_id: int) -> Picture | None:
        """Return the altered picture; None where the hook is late.

        Raises:
            LiveError: when the hook fails, or returns something else than such a picture.
        """
        try:
            if self._running:
                self._checked(self._answers.get_nowait(), picture)
            self._asked.put((picture.copy(), frame_id))
            self._running = True
            return self._checked(self._answers.get(timeout=self._limit_s), picture)
        except queue.Empty:
            return None

    def _checked(self, answer: object, picture: Picture) -> Picture:
        self._running = False
        if isinstance(answer, BaseException):
            raise LiveError(
                f"Expected the hook to return a picture, found {type(answer).__name__}: {answer}. Correct the hook."
            ) from answer
        if not isinstance(answer, np.ndarray) or answer.shape != picture.shape or answer.dtype != np.uint8:
            raise LiveError(
                f"Expected the hook to return 8-bit RGB of shape {picture.shape}, found {found_instead(answer)}. "
                "Return the picture that it was given, altered."
            )
        return np.ascontiguousarray(answer)  # sinks take no turned or cut views

    def _work(self) -> None:
        while True:
            picture, frame_id = self._asked.get()
            try:
                self._answers.put(self._function(picture, frame_id))
            except BaseException as error:  # sys.exit() of a hook would end this thread without a word
                self._answers.put(error)
