"""OpenEXR files: named float32 channels of one size. The only module that imports OpenEXR."""

from __future__ import annotations

import errno
import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import OpenEXR
from jaxtyping import Float, Float32

from udccal.errors import FileFormatError
from udccal.io.atomic import atomic_path
from udccal.io.limits import Shape, check_size

# Measured on 2048 x 1536 x 2 channels of noisy averages: ZIPS 0.18 s and 25.0 MB, ZIP 0.29 s and 23.7 MB,
# PIZ 0.61 s and 21.2 MB, none 0.05 s and 25.2 MB. ZIPS is quick and still shrinks maps that are smooth or empty.
_COMPRESSION = OpenEXR.ZIPS_COMPRESSION
# Limit for files that udccal writes, whose shape is known; a rendered photograph may have more channels.
_MOST_CHANNELS = 3


def read_exr(path: Path, shape: Shape | None = None) -> dict[str, Float32[np.ndarray, "rows columns"]]:
    """Read every channel of a single-part EXR as float32, by name.

    Args:
        path: the file.
        shape: expected (rows, columns); files of another shape, or with more than three channels, are not decoded.

    Raises:
        FileFormatError: when the file is missing, truncated, too large or of another shape, has subsampled channels or
            values that are not finite, or its path is not text.
    """
    check_path(path)
    try:
        names = _checked_channel_names(path, shape)
        with OpenEXR.File(str(path), separate_channels=True) as file:
            if not file.parts:  # the library only warns when pixel data cannot be decoded
                raise FileFormatError(_unreadable(path, "pixel data cut short or damaged"))
            channels = {name: _plane(file.channels(0)[name].pixels) for name in names}
    except (RuntimeError, ValueError, KeyError, TypeError, OSError) as error:
        raise FileFormatError(_unreadable(path, str(error))) from error
    for name, plane in channels.items():
        if not np.isfinite(plane).all():
            raise FileFormatError(
                f"Expected finite numbers in channel '{name}' of {path}, found NaN or infinity. Write the file again."
            )
    return channels


def write_exr(path: Path, channels: Mapping[str, Float[np.ndarray, "rows columns"]]) -> None:
    """Write channels as 32-bit floats, atomically and compressed without loss.

    Args:
        path: the file; an earlier one is replaced.
        channels: arrays of one size, by name.

    Raises:
        OSError: when the disk is full or cannot be written to.
        FileFormatError: when there is nothing to write, sizes differ or are out of bounds, a value is not finite, or
            the path is not text.
    """
    planes = {name: np.ascontiguousarray(plane, dtype=np.float32) for name, plane in channels.items()}
    shapes = {plane.shape for plane in planes.values()}
    if len(shapes) != 1:
        raise FileFormatError(f"Expected channels of one size for {path}, found sizes {sorted(shapes)}. Give all one.")
    rows, columns = shapes.pop()
    check_size(path, rows, columns, len(planes))
    for name, plane in planes.items():
        if not np.isfinite(plane).all():
            raise FileFormatError(
                f"Expected finite numbers for channel '{name}' of {path}, found NaN or infinity. Check what they were "
                "computed from."
            )
    header = {"compression": _COMPRESSION, "type": OpenEXR.scanlineimage}
    check_path(path)
    with atomic_path(path) as temporary, OpenEXR.File(header, planes) as file:
        try:
            file.write(str(temporary))
        except RuntimeError as error:
            reason = _reason(error)
            raise OSError(reason, os.strerror(reason)) from error


def read_rgb_exr(path: Path) -> Float32[np.ndarray, "rows columns 3"]:
    """Read the channels R, G, B; other channels (alpha, depth) are ignored.

    Raises:
        FileFormatError: as ``read_exr``, and when one of the three is absent.
    """
    channels = read_exr(path)
    missing = [name for name in "RGB" if name not in channels]
    if missing:
        raise FileFormatError(
            f"Expected channels R, G and B in {path}, found {', '.join(sorted(channels))}. Use a colour picture."
        )
    return np.stack([channels[name] for name in "RGB"], axis=-1)


def write_rgb_exr(path: Path, picture: Float[np.ndarray, "rows columns 3"]) -> None:
    """Write a linear RGB picture with the channels R, G, B.

    Args:
        path: the file; an earlier one is replaced.
        picture: linear values.

    Raises:
        OSError, FileFormatError: as ``write_exr``.
    """
    write_exr(path, {name: picture[..., index] for index, name in enumerate("RGB")})


def check_path(path: Path) -> None:
    """Refuse a path that is not text in UTF-8, which the library cannot open.

    Raises:
        FileFormatError: when it is not.
    """
    try:
        str(path).encode("utf-8")
    except UnicodeEncodeError as error:
        raise FileFormatError(
            f"Expected the path of an EXR file in UTF-8, found other bytes in {path}. Rename the folder or file."
        ) from error


def _checked_channel_names(path: Path, shape: Shape | None) -> list[str]:
    """Read the channel names from the header, and refuse a file that is too large to read."""
    if not path.is_file():
        raise FileFormatError(f"Expected an EXR file at {path}, found none. Check the path.")
    with OpenEXR.File(str(path), header_only=True) as file:
        if len(file.parts) != 1:
            raise FileFormatError(_unreadable(path, f"{len(file.parts)} parts"))
        header = dict(file.header(0))  # a copy: the file's own is emptied when it closes
    (left, top), (right, bottom) = header["dataWindow"]
    described = header["channels"]
    check_size(path, int(bottom) - int(top) + 1, int(right) - int(left) + 1, len(described), shape)
    if shape is not None and len(described) > _MOST_CHANNELS:
        raise FileFormatError(_unreadable(path, f"{len(described)} channels"))
    if any(channel.xSampling != 1 or channel.ySampling != 1 for channel in described):
        raise FileFormatError(_unreadable(path, "subsampled channels"))
    return [channel.name for channel in described]


def _reason(error: RuntimeError) -> int:
    """Return the error number of a failed write, which the library reports only in words."""
    reasons = (errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EROFS)
    return next((reason for reason in reasons if os.strerror(reason) in str(error)), errno.EIO)


def _plane(pixels: np.ndarray) -> Float32[np.ndarray, "rows columns"]:
    if pixels.ndim != 2:
        raise ValueError(f"pixels of {pixels.ndim} dimensions")
    return np.ascontiguousarray(pixels, dtype=np.float32)


def _unreadable(path: Path, found: str) -> str:
    return f"Expected {path} to be a whole single-part OpenEXR file, found: {found}. Copy or capture it again."
