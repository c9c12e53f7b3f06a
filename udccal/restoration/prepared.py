"""What is computed once per profile, kept on disk between starts of programs.

An entry is one file: the SHA-256 of all that follows, then the arrays of one object in the order of its fields, as
``.npy``. Its name has the SHA-256 of everything that the object depends on: numbers, options, and the code that
computes it. So whatever changes, an old entry is not read; and two profiles that share a term share its entry. An entry
that is damaged, or does not hold such arrays, is made anew. A folder that cannot be used costs time only.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import os
import typing
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from jaxtyping import jaxtyped
from pydantic import BaseModel

from udccal import __version__
from udccal.arguments import check_is_path
from udccal.compilation import compilation_folder, private_folder
from udccal.errors import RestorationError
from udccal.io.atomic import atomic_path

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    T = TypeVar("T", bound=DataclassInstance)
else:
    T = TypeVar("T")

# The version of the files' layout.
_FORMAT = 1
_MOST_BYTES = 2 * 2**30
_CHECKSUM = "sha256"
_CHECKSUM_BYTES = 32
_SUFFIX = ".prepared"


def prepared_folder() -> Path:
    """Where programs that own their process keep what they prepare: beside the compilations."""
    return compilation_folder().parent / "prepared"


def checked_folder(keep: Any) -> Path | None:
    """Return the folder that a caller gave for entries, which need not exist; None for none.

    Raises:
        RestorationError: when it is no path, or a file's.
    """
    if keep is None:
        return None
    check_is_path(keep, "a folder that keeps what is computed", RestorationError)
    if (folder := Path(keep)).is_file():
        raise RestorationError(f"Expected a folder that keeps what is computed, found the file {folder}. Name another.")
    return folder


def prepared_bytes(folder: Path) -> int:
    """Return the bytes of all entries in a folder, which need not exist."""
    return sum(size for _, size, _ in _entries(folder))


def kept(folder: Path | None, kind: type[T], depends_on: tuple[object, ...], make: Callable[[], T]) -> T:
    """Return an object of arrays from its entry, or make it and write the entry.

    Several programs may do so at once; each finds a whole entry or none.

    Args:
        folder: of the entries, made for its owner alone; None to keep nothing.
        kind: the object's class, a dataclass whose fields are all arrays, with jaxtyping annotations.
        depends_on: everything that ``make`` uses: arrays, numbers, texts, rigs, and dataclasses of these.
        make: computes the object; its errors pass through, and leave no entry.
    """
    if folder is None or not private_folder(folder):
        return make()
    path = folder / f"{kind.__name__}-{_key(kind, depends_on)}{_SUFFIX}"
    found = _read(path, kind)
    if found is not None:
        return found
    made = make()
    with contextlib.suppress(OSError):
        _write(path, made)
    return made


def checksum(*values: object) -> str:
    """Return the SHA-256 of values as ``depends_on`` may have them: the same numbers have the same in any precision."""
    sha = hashlib.sha256()
    _feed(sha, values)
    return sha.hexdigest()


def _read(path: Path, kind: type[T]) -> T | None:
    """Return what an entry holds, if it is whole and its arrays are what the class says; mark it as used."""
    try:
        with path.open("rb") as stream:
            stated = stream.read(_CHECKSUM_BYTES)
            if hashlib.file_digest(stream, _CHECKSUM).digest() != stated:
                return None
            stream.seek(_CHECKSUM_BYTES)
            arrays = [np.lib.format.read_array(stream, allow_pickle=False) for _ in dataclasses.fields(kind)]
    except (OSError, ValueError, EOFError, MemoryError):
        return None
    with contextlib.suppress(OSError):  # Another program may have removed it.
        os.utime(path)
    build: Callable[..., T] = kind
    return build(*arrays) if _as_declared(arrays, kind) else None


def _as_declared(arrays: list[np.ndarray], kind: type[T]) -> bool:
    """Return whether arrays have the fields' types and shapes, and finite values."""
    hints = typing.get_type_hints(kind)
    with jaxtyped("context"):  # A size that several annotations name is the same in all of them.
        typed = all(
            isinstance(array, hints[field.name]) for array, field in zip(arrays, dataclasses.fields(kind), strict=True)
        )
    return typed and all(bool(np.all(np.isfinite(array))) for array in arrays)


def _write(path: Path, made: DataclassInstance) -> None:
    """Write an entry, unless it alone takes more than all may; then remove entries beyond this, oldest use first.

    Raises:
        OSError: when it cannot be written.
    """
    arrays = [getattr(made, field.name) for field in dataclasses.fields(made)]
    if sum(array.nbytes for array in arrays) > _MOST_BYTES:
        return
    with atomic_path(path) as temporary, temporary.open("r+b") as stream:
        stream.write(bytes(_CHECKSUM_BYTES))
        for array in arrays:
            np.save(stream, array, allow_pickle=False)
        stream.seek(_CHECKSUM_BYTES)
        checksum = hashlib.file_digest(stream, _CHECKSUM).digest()
        stream.seek(0)
        stream.write(checksum)
    total = 0
    for _, size, entry in sorted(_entries(path.parent), reverse=True):
        total += size
        if total > _MOST_BYTES:
            entry.unlink(missing_ok=True)


def _entries(folder: Path) -> list[tuple[int, int, Path]]:
    """Return (time of last use in ns, bytes, path) of entries, and of what killed programs left of them."""
    found = []
    for path in folder.glob(f"*{_SUFFIX}"):
        with contextlib.suppress(OSError):  # Another program may have removed it.
            status = path.stat()
            found.append((status.st_mtime_ns, status.st_size, path))
    return found


def _key(kind: type, depends_on: tuple[object, ...]) -> str:
    sha = hashlib.sha256(f"{_FORMAT} {__version__} {_code()} {kind.__qualname__}".encode())
    _feed(sha, depends_on)
    return sha.hexdigest()


@functools.cache
def _code() -> str:
    """Return the SHA-256 of the modules that may take part in computing entries."""
    package = Path(__file__).parents[1]
    sha = hashlib.sha256()
    for path in sorted(path for part in (".", "models", "restoration") for path in (package / part).glob("*.py")):
        sha.update(hashlib.sha256(path.read_bytes()).digest())
    return sha.hexdigest()


def _feed(sha: Any, value: object) -> None:
    """Add a value to a checksum, with its type and size, so that different values never give the same bytes.

    Raises:
        TypeError: when the value is none of those that ``kept`` names.
    """
    if isinstance(value, BaseModel):
        _feed(sha, value.model_dump_json())
    elif dataclasses.is_dataclass(value):
        sha.update(f"{type(value).__qualname__}:".encode())
        _feed(sha, tuple(getattr(value, field.name) for field in dataclasses.fields(value)))
    elif isinstance(value, tuple):
        sha.update(f"{len(value)} values:".encode())
        for part in value:
            _feed(sha, part)
    elif isinstance(value, str):
        sha.update(f"{len(value.encode())} bytes:{value}".encode())
    else:
        array = np.asarray(value)
        if array.dtype.kind not in "biufc":
            raise TypeError(f"expected a number, a text, an array or a dataclass of these, found {type(value)}")
        # A fitted term and one read from a file hold the same numbers in different precisions.
        array = array.astype(np.float64) if array.dtype.kind == "f" else array
        sha.update(f"{array.dtype.str}{array.shape}:".encode() + array.tobytes())
