"""JAX's compilations: kept on disk between runs, and their time counted apart from the work's."""

from __future__ import annotations

import functools
import hashlib
import os
import platform
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import final

import jax

from udccal.io.home import home_folder

FOLDER_VARIABLE = "UDCCAL_COMPILATIONS"
_MOST_BYTES = 512 * 2**20
# The compiler's own share, and tracing and lowering before it.
_EVENTS = (
    "/jax/core/compile/jaxpr_trace_duration",
    "/jax/core/compile/jaxpr_to_mlir_module_duration",
    "/jax/core/compile/backend_compile_duration",
)


def compilation_folder() -> Path:
    """Where compilations for this processor are kept, below ``$UDCCAL_COMPILATIONS`` or the user's cache folder.

    A home folder may be shared by machines of different processors; code made for one may not run on another.
    """
    given, cache = os.environ.get(FOLDER_VARIABLE), os.environ.get("XDG_CACHE_HOME")
    base = Path(given) if given else (Path(cache) if cache else _cache_folder()) / "udccal" / "compilations"
    return base / processor_key()


def processor_key() -> str:
    """Return a name that processors which can do the same share."""
    return f"{platform.machine()}-{hashlib.sha256(_processor()).hexdigest()[:12]}"


def _cache_folder() -> Path:
    """Return the user's own, below home; a user without a home has one beside others' temporary files."""
    home = home_folder()
    return Path(tempfile.gettempdir()) / f"cache-{os.getuid()}" if home is None else home / ".cache"


def _processor() -> bytes:
    """What the processor can do, as far as the system tells."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return platform.processor().encode()
    lines = {line for line in text.splitlines() if line.startswith(("flags", "Features", "model name"))}
    return "\n".join(sorted(lines)).encode()


def keep_compilations() -> None:
    """Read and write compiled functions in ``compilation_folder``; for programs that own their process.

    What cannot be read or written there is compiled anew. A folder that the program's user set for JAX stays.
    """
    if jax.config.values["jax_compilation_cache_dir"]:
        return
    folder = compilation_folder()
    if private_folder(folder):
        jax.config.update("jax_compilation_cache_dir", str(folder))
        # The smallest ones, too: to read one takes a quarter of the time to make it.
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.config.update("jax_compilation_cache_max_size", _MOST_BYTES)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)


def private_folder(folder: Path) -> bool:
    """Make a folder, and return whether its owner alone may write to it: what is read from it is run, or trusted."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = folder.stat()
        own = os.name != "posix" or status.st_uid == os.geteuid()
        return own and status.st_mode & 0o022 == 0 and os.access(folder, os.W_OK)
    except OSError:
        return False


@final
@dataclass
class CompilationClock:
    """Seconds that tracing and compiling took since the clock was made, on all threads together."""

    seconds: float = 0.0

    def _listen(self, event: str, duration_secs: float, **_: str | int | float) -> None:
        if event in _EVENTS:
            self.seconds += duration_secs


@functools.cache
def compilation_clock() -> CompilationClock:
    """The process's one clock; it begins to count when it is first asked for."""
    clock = CompilationClock()
    jax.monitoring.register_event_duration_secs_listener(clock._listen)
    return clock
