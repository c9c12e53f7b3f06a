"""A queue of one between two threads, in which the newest item wins."""

from __future__ import annotations

import threading
from typing import Generic, TypeVar, final

T = TypeVar("T")


@final
class Newest(Generic[T]):
    """Holds the newest item that nobody has taken yet; whoever puts never waits."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._item: T | None = None
        self._closed = False

    def put(self, item: T) -> bool:
        """Offer an item; return whether one that nobody had taken was lost. A closed queue drops it without a word."""
        with self._changed:
            if self._closed:
                return False
            lost, self._item = self._item is not None, item
            self._changed.notify()
            return lost

    def get(self) -> T | None:
        """Wait for an item and take it; return None when the queue is closed and empty."""
        with self._changed:
            self._changed.wait_for(lambda: self._item is not None or self._closed)
            item, self._item = self._item, None
            return item

    def close(self) -> None:
        """Accept no more items; the one that is there may still be taken."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
