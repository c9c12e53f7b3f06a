"""Reads frames on a separate thread, so that none is lost while the caller works on the one before."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import Final, Protocol, final, runtime_checkable

from udccal.cameras.u3v.receiver import Block
from udccal.errors import CameraTimeout

_POLL_S: Final = 0.05
# Beyond this many bytes of waiting payloads the camera drops frames, whose ids are then missing.
_MOST_BYTES: Final = 256 << 20
_MOST_BUFFERS: Final = 32


@runtime_checkable
class Source(Protocol):
    """A source of blocks: a receiver."""

    @property
    def room(self) -> int:
        """Bytes that a buffer for a payload must have."""
        ...

    def receive(self, payload: memoryview, wait_s: float, stopped: Callable[[], bool]) -> Block | None:
        """The next block."""
        ...


@final
@dataclass(frozen=True)
class _Filled:
    buffer: bytearray
    block: Block


@final
class ReadAhead:
    """Reads up to ``count`` blocks into a few buffers that circulate between a thread and the caller.

    Args:
        wait_s: longest wait for each block while the caller waits for it.
    """

    def __init__(self, source: Source, count: int, wait_s: float) -> None:
        self._source = source
        self._count = count
        self._wait_s = wait_s
        self._stop = threading.Event()
        self._asked = threading.Event()
        self._free: queue.Queue[bytearray] = queue.Queue()
        self._filled: queue.Queue[_Filled | Exception] = queue.Queue()
        for _ in range(max(2, min(count, _MOST_BUFFERS, _MOST_BYTES // source.room))):
            self._free.put(bytearray(source.room))
        self._thread = threading.Thread(target=self._run, name="udccal-u3v-stream", daemon=True)

    def blocks(self) -> Generator[tuple[memoryview, Block], None, None]:
        """Yield blocks with their payloads; each payload is valid until the next block is requested.

        Raises:
            CameraError: the error that stopped the reading, after all blocks before it.
        """
        self._asked.set()
        self._thread.start()
        try:
            for _ in range(self._count):
                self._asked.set()
                item = self._filled.get()
                self._asked.clear()
                if isinstance(item, Exception):
                    raise item
                yield memoryview(item.buffer), item.block
                self._free.put(item.buffer)
        finally:
            self._stop.set()
            self._thread.join()

    def _run(self) -> None:
        try:
            for _ in range(self._count):
                buffer = self._empty_buffer()
                block = None if buffer is None else self._receive(buffer)
                if buffer is None or block is None:
                    return
                self._filled.put(_Filled(buffer, block))
        except Exception as error:
            # Every error goes to the caller, who would wait for ever otherwise.
            self._filled.put(error)

    def _receive(self, buffer: bytearray) -> Block | None:
        """Return the next block; raise a time-out only if the caller has been waiting for it the whole time."""
        while not self._stop.is_set():
            asked = self._asked.is_set()
            try:
                return self._source.receive(memoryview(buffer), self._wait_s, self._stop.is_set)
            except CameraTimeout:
                if asked and self._asked.is_set():
                    raise
        return None

    def _empty_buffer(self) -> bytearray | None:
        """Return a buffer that the caller has returned; None when stopped."""
        while not self._stop.is_set():
            try:
                return self._free.get(timeout=_POLL_S)
            except queue.Empty:
                continue
        return None
