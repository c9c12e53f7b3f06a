"""``shm:NAME``: POSIX shared memory in which any number of other programs find the newest frames.

The segment is locked by its writer for as long as the writer lives, however it ends. So one without a lock is of a
writer that died, and the next run removes it. That is needed where Python's resource tracker was killed too: it is a
process of its own, which removes the name that a killed writer leaves.
"""

from __future__ import annotations

import mmap
import os
import re
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Final, final

from udccal.errors import LiveError
from udccal.io.out_folder import check_writable
from udccal.live.sinks.frame_ring import MAGIC, FrameRing, Layout
from udccal.live.sinks.protocol import RestoredFrame

# Where Linux shows POSIX shared memory.
_FOLDER: Final = Path("/dev/shm")


@final
class SharedMemorySink:
    """Implements ``udccal.live.sinks.protocol.Sink``; readers cannot slow it down."""

    def __init__(self, target: str, rate_hz: float) -> None:
        if not re.fullmatch(r"[A-Za-z0-9_-][A-Za-z0-9._-]{0,99}", target):
            raise LiveError(
                f"Expected shm:NAME with a name of letters, digits, '_', '-' and '.', found '{target}'. Choose another."
            )
        if sys.platform != "linux":
            raise LiveError(f"Expected Linux for --sink shm, found {sys.platform}. Use --sink video:FILE.mp4.")
        self._path = _FOLDER / target
        check_writable(_FOLDER)
        with _stale(self._path):
            pass
        self._descriptor: int | None = None
        self._ring: FrameRing | None = None
        self._tracking = ExitStack()

    def open(self, shape: tuple[int, int]) -> None:
        """Make the segment; remove that of a writer that died.

        Raises:
            LiveError: when the name is taken, or there is not enough memory.
        """
        layout = Layout(*shape)
        self._descriptor = _unnamed(layout.total_bytes)
        self._ring = FrameRing(mmap.mmap(self._descriptor, layout.total_bytes), layout)
        with _stale(self._path) as stale:
            if stale is not None and _is_at(stale, self._path):
                self._path.unlink()
        try:
            # A directory's descriptor makes Python ask the system to follow the link to the unnamed file.
            os.link(f"/proc/self/fd/{self._descriptor}", self._path, src_dir_fd=self._descriptor)
        except FileExistsError as error:
            raise _taken(self._path, "one that has just been made") from error
        tracked = f"/{self._path.name}", "shared_memory"
        resource_tracker.register(*tracked)
        self._tracking.callback(resource_tracker.unregister, *tracked)

    def write(self, frame: RestoredFrame) -> None:
        """Publish a frame."""
        assert self._ring is not None
        self._ring.publish(frame)

    def close(self) -> None:
        """Tell the readers, and remove the name; readers keep what they have open."""
        if self._descriptor is None:
            return
        if self._ring is not None:
            self._ring.close()
        if _is_at(self._descriptor, self._path):
            self._path.unlink()
        self._tracking.close()
        os.close(self._descriptor)
        self._descriptor = None


def _unnamed(size: int) -> int:
    """Return the descriptor of a locked file without a name, with all its memory reserved."""
    descriptor = os.open(_FOLDER, os.O_TMPFILE | os.O_RDWR, 0o600)
    try:
        _lock(descriptor)
        os.posix_fallocate(descriptor, 0, size)
    except OSError as error:
        os.close(descriptor)
        raise LiveError(
            f"Expected {size} bytes of shared memory in {_FOLDER}, found: {error}. Free some, or enlarge it."
        ) from error
    return descriptor


@contextmanager
def _stale(path: Path) -> Iterator[int | None]:
    """Yield the descriptor of the segment of a writer that died, locked; None where the name is free.

    Raises:
        LiveError: when the name is that of a living writer, or of something else.
    """
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_NOFOLLOW)
    except FileNotFoundError:
        yield None
        return
    except OSError as error:
        raise _taken(path, str(error)) from error
    try:
        if os.read(descriptor, len(MAGIC)) != MAGIC:
            raise _taken(path, "another program's memory")
        _lock(descriptor)
        yield descriptor
    except BlockingIOError as error:
        raise _taken(path, "a run that still writes to it") from error
    finally:
        os.close(descriptor)


def _lock(descriptor: int) -> None:
    """Lock a file for as long as it is open here; raise BlockingIOError where another process has locked it."""
    import fcntl  # not on every system

    fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _is_at(descriptor: int, path: Path) -> bool:
    """Return whether a name is still that of an open file."""
    return path.exists() and os.path.samestat(os.fstat(descriptor), path.stat())


def _taken(path: Path, found: str) -> LiveError:
    return LiveError(f"Expected the name shm:{path.name} to be free, found {found}. Choose another name, or end it.")
