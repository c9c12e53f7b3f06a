"""Arrays in EXR files: exact in float64, and viewable in any EXR viewer.

A float64 is written as up to three float32 channels that sum to it: 3 x 24 bits hold its 53. Magnitudes below about
1e-22 keep an absolute accuracy of 1e-45 instead.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import cast, get_args

import numpy as np
from jaxtyping import Float, Shaped

from udccal.errors import FileFormatError, ProfileError
from udccal.io.exr import read_exr, write_exr
from udccal.io.hashing import sha256_file
from udccal.io.limits import Shape
from udccal.io.links import is_plain_file
from udccal.io.reading import reading
from udccal.profiles.schema import INLINE_VALUES, DType, Numbers, StoredArray

_CHANNELS = ("value", "remainder", "remainder2")
MAX_FILE_BYTES = 512 * 1024 * 1024
_DTYPES = {name: np.dtype(name) for name in get_args(DType)}


def fits_inline(array: Shaped[np.ndarray, "..."]) -> bool:
    """Return whether an array is small enough for profile.json (an empty one always is)."""
    return array.size <= INLINE_VALUES


def inline(name: str, array: Shaped[np.ndarray, "..."], unit: str, sigma: tuple[float, ...] | None) -> Numbers:
    """Return a small array as JSON. Python writes a float with enough digits to read back the same float."""
    _check_storable(name, array)
    values = tuple(float(v) for v in array.ravel())
    return Numbers(name=name, dtype=_dtype_name(array), shape=array.shape, value=values, unit=unit, sigma=sigma)


def from_inline(stored: Numbers) -> Shaped[np.ndarray, "..."]:
    """Return the array that ``inline`` stored.

    Raises:
        ProfileError: when the number of values does not fit the shape.
    """
    if math.prod(stored.shape) != len(stored.value):
        raise ProfileError(
            f"Expected {math.prod(stored.shape)} values for '{stored.name}' of shape {stored.shape}, "
            f"found {len(stored.value)}. Restore the profile from a copy."
        )
    return _shaped(np.array(stored.value, dtype=np.float64), stored)


def store(folder: Path, file: str, name: str, array: Shaped[np.ndarray, "..."], unit: str) -> StoredArray:
    """Write a large array to ``folder/file``."""
    _check_storable(name, array)
    rest = array.astype(np.float64).reshape(-1, array.shape[-1] if array.ndim else 1)
    channels: dict[str, Float[np.ndarray, "rows columns"]] = {}
    for channel in _CHANNELS:
        if channels and not rest.any():
            break
        with np.errstate(under="ignore"):
            channels[channel] = rest.astype(np.float32)
        rest = rest - channels[channel].astype(np.float64)
    write_exr(folder / file, channels)
    return StoredArray(
        name=name, file=file, sha256=sha256_file(folder / file), dtype=_dtype_name(array), shape=array.shape, unit=unit
    )


def load(folder: Path, stored: StoredArray) -> Shaped[np.ndarray, "..."]:
    """Read an array that ``store`` wrote.

    Raises:
        ProfileError: when the file is missing, altered, too large or of another shape.
    """
    columns = stored.shape[-1] if stored.shape else 1
    rows = math.prod(stored.shape[:-1])
    channels = read_checked(folder, stored.file, stored.sha256, (rows, columns))
    planes = [channels[name].astype(np.float64) for name in _CHANNELS if name in channels]
    if len(planes) != len(channels) or not planes:
        raise ProfileError(
            f"Expected the channels {', '.join(_CHANNELS)} in {stored.file}, or the first of them, found "
            f"{', '.join(channels)}. Restore the profile from a copy."
        )
    # Smallest first: the partial sums are then exact.
    with np.errstate(invalid="ignore", over="ignore"):
        total = sum(reversed(planes[:-1]), start=planes[-1])
    return _shaped(total, stored)


def read_checked(
    folder: Path, file: str, sha256: str, shape: Shape | None = None
) -> Mapping[str, Float[np.ndarray, "rows columns"]]:
    """Read the channels of an EXR file of a profile after checking its size, checksum and (rows, columns).

    Raises:
        ProfileError: when it is missing, a link, too large, altered, of another shape, or not an EXR file.
    """
    path = folder / file
    with reading(path, ProfileError):
        size = path.stat().st_size if is_plain_file(folder, path) else None
    if size is None:
        raise ProfileError(f"Expected the file {file} in {folder}, found none. Copy the whole profile again.")
    if size > MAX_FILE_BYTES:
        raise ProfileError(
            f"Expected {path} to hold at most {MAX_FILE_BYTES} bytes, found {size}. It does not belong to a profile."
        )
    with reading(path, ProfileError):
        found = sha256_file(path)
    if found != sha256:
        raise ProfileError(
            f"Expected {path} to have the SHA-256 {sha256[:12]}..., found {found[:12]}...: the file was changed after "
            "the profile was made. Restore it from a copy, or make the profile again."
        )
    try:
        return read_exr(path, shape)
    except FileFormatError as error:
        raise ProfileError(str(error)) from error


def _shaped(values: Float[np.ndarray, "..."], stored: Numbers | StoredArray) -> Shaped[np.ndarray, "..."]:
    """Return values in the stored shape and type, after checking that both can hold them."""
    # An empty array may have any other sizes next to its zero; numpy accepts them only up to a limit.
    sizes = math.prod(size for size in stored.shape if size)
    with np.errstate(invalid="ignore", over="ignore"):
        typed = values.astype(_DTYPES[stored.dtype])
    if sizes > MAX_FILE_BYTES or not np.all(np.isfinite(typed)):
        raise ProfileError(
            f"Expected '{stored.name}' to hold finite numbers of {stored.dtype} and at most {MAX_FILE_BYTES} of them, "
            f"found others in shape {stored.shape}. Restore the profile from a copy."
        )
    return typed.reshape(stored.shape)


def _dtype_name(array: Shaped[np.ndarray, "..."]) -> DType:
    return cast(DType, str(array.dtype))


def _check_storable(name: str, array: Shaped[np.ndarray, "..."]) -> None:
    if str(array.dtype) not in _DTYPES:
        raise ProfileError(f"Expected '{name}' to be of one of {', '.join(_DTYPES)}, found {array.dtype}.")
    if array.size and not np.all(np.isfinite(array)):
        raise ProfileError(f"Expected finite values of '{name}', found NaN or infinity. Do not store this fit.")
