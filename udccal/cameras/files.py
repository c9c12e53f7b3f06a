"""Files as a camera: the frames of camera raw files (DNG and others), 16-bit PNG, or EXR, in the order given."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import final

import numpy as np
import rawpy
from jaxtyping import UInt16

from udccal.cameras.protocol import CameraIdentity, Frame, Region, Settings
from udccal.errors import CameraError, FileFormatError
from udccal.io.exr import read_exr
from udccal.io.limits import check_size
from udccal.io.png import read_png16


@dataclass(frozen=True)
class Mosaic:
    """One raw picture with what its file says about it; ``exposure_s`` is absent where the file does not say."""

    data: UInt16[np.ndarray, "rows columns"]
    cfa: str
    black_DN: float
    saturation_DN: int
    exposure_s: float | None


def read_raw(path: Path) -> Mosaic:
    """Read the visible part of a Bayer mosaic from a camera raw file.

    Raises:
        FileFormatError: when it is missing, not a raw file, damaged, too large, or not a 2 x 2 Bayer mosaic.
    """
    if not path.is_file():
        raise FileFormatError(f"Expected a camera raw file at {path}, found none. Check the path.")
    try:
        with closing(rawpy.RawPy()) as raw:
            raw.open_file(str(path))
            check_size(path, raw.sizes.raw_height, raw.sizes.raw_width)
            raw.unpack()
            return _mosaic(path, raw)
    except rawpy.LibRawError as error:
        reason = error.args[0] if error.args else type(error).__name__
        shown = reason.decode("ascii", "replace") if isinstance(reason, bytes) else str(reason)
        message = f"Expected {path} to be a whole camera raw file, found: {shown}. Copy it again."
        raise FileFormatError(message) from error


def _mosaic(path: Path, raw: rawpy.RawPy) -> Mosaic:
    bayer = raw.raw_type == rawpy.RawType.Flat and raw.raw_pattern is not None and raw.raw_pattern.shape == (2, 2)
    names = raw.color_desc.decode("ascii", "replace")
    cfa = "".join(names[int(index)] for index in raw.raw_colors_visible[:2, :2].ravel()) if bayer else ""
    if sorted(cfa) != ["B", "G", "G", "R"]:
        raise FileFormatError(f"Expected a 2 x 2 Bayer mosaic in {path}, found another layout. Use a raw Bayer file.")
    other = getattr(raw, "other", None)  # older rawpy does not tell
    exposure_s = float(other.shutter_speed) if other is not None else 0.0
    return Mosaic(
        data=raw.raw_image_visible.copy(),
        cfa=cfa,
        black_DN=float(np.mean(raw.black_level_per_channel)),
        saturation_DN=int(raw.white_level),
        exposure_s=exposure_s if exposure_s > 0 else None,
    )


@final
class FileCamera:
    """A camera whose frames are files. It starts at the first again only when entered again.

    Raw files say their own pattern and level; for PNG and EXR, which do not, give ``cfa`` and ``bits``.
    """

    def __init__(self, paths: Sequence[str | Path], cfa: str = "RGGB", bits: int = 16, exposure_s: float = 1.0) -> None:
        """Open a list of files of one size.

        Args:
            paths: in the order of the frames.
            cfa: pattern of PNG and EXR files.
            bits: of PNG and EXR files.
            exposure_s: of files that do not say theirs.

        Raises:
            CameraError: when the list is empty.
            FileFormatError: when the first file cannot be read.
        """
        if not paths:
            raise CameraError("Expected at least one file to take frames from, found none. List the files.")
        self._paths = tuple(Path(path) for path in paths)
        self._default = (cfa, bits, exposure_s)
        first = self._read(self._paths[0])
        self._cfa, self._bits = first.cfa, max(int(first.saturation_DN).bit_length(), 1)
        self._sensor = Region(0, 0, first.data.shape[1], first.data.shape[0])
        self._identity = CameraIdentity("files", self._paths[0].suffix.lstrip("."), self._paths[0].name[:100], "files")
        self._region = self._sensor
        self._next = 0

    @property
    def identity(self) -> CameraIdentity:
        """The kind and the name of the first file: files do not say reliably which camera made them."""
        return self._identity

    @property
    def sensor(self) -> Region:
        """The size of the first file."""
        return self._sensor

    @property
    def cfa(self) -> str:
        """Pattern of the top-left 2 x 2."""
        return self._cfa

    @property
    def bits(self) -> int:
        """Bits that hold the saturation level."""
        return self._bits

    def __enter__(self) -> FileCamera:
        """Begin with the first file."""
        self._next = 0
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Nothing is held open."""

    def configure(self, settings: Settings) -> Settings:
        """Choose a region; exposure and gain were decided when the files were made and are told with each frame.

        Raises:
            CameraError: when the region is not inside the picture or not aligned to the pattern.
        """
        region = settings.region
        spare_x, spare_y = self._sensor.columns - region.columns, self._sensor.rows - region.rows
        inside = 0 <= region.x <= spare_x and 0 <= region.y <= spare_y
        if not inside or region.x % 2 or region.y % 2 or min(region.columns, region.rows) < 1:
            raise CameraError(
                f"Expected an even-aligned region inside {self._sensor.columns} x {self._sensor.rows}, found "
                f"{region.columns} x {region.rows} at ({region.x}, {region.y}). Choose one inside."
            )
        self._region = region
        return Settings(self._default[2], 0.0, region)

    def frames(self, count: int) -> Iterator[Frame]:
        """The next files, one at a time.

        Raises:
            CameraError: when the files are used up, or one has another size or pattern than the first.
            FileFormatError: when one cannot be read.
        """
        for _ in range(count):
            if self._next >= len(self._paths):
                raise CameraError(
                    f"Expected {count} more frames, found that all {len(self._paths)} files are used. List more files."
                )
            index, self._next = self._next, self._next + 1
            yield self._frame(index)

    def _frame(self, index: int) -> Frame:
        mosaic = self._read(self._paths[index])
        if mosaic.data.shape != (self._sensor.rows, self._sensor.columns) or mosaic.cfa != self._cfa:
            raise CameraError(
                f"Expected {self._paths[index]} to have the size and pattern of {self._paths[0]}, found another. "
                "Take the files of one camera."
            )
        region = self._region
        data = mosaic.data[region.y : region.y + region.rows, region.x : region.x + region.columns].copy()
        exposure = mosaic.exposure_s if mosaic.exposure_s is not None else self._default[2]
        return Frame(data, Settings(exposure, 0.0, region), self._paths[index].stat().st_mtime, index, True)

    def _read(self, path: Path) -> Mosaic:
        cfa, bits, _ = self._default
        match path.suffix.lower():
            case ".png":
                data = read_png16(path)
            case ".exr":
                data = _single_plane(path)
            case _:
                return read_raw(path)
        limit = 2**bits - 1
        if int(data.max()) > limit:
            raise CameraError(f"Expected samples of {bits} bits in {path}, found {int(data.max())} DN. Give its bits.")
        return Mosaic(data, cfa, 0.0, limit, None)


def _single_plane(path: Path) -> UInt16[np.ndarray, "rows columns"]:
    """An EXR of one channel that holds whole numbers of DN."""
    channels = list(read_exr(path).values())
    if len(channels) != 1 or channels[0].min() < 0 or channels[0].max() > 65535:
        raise FileFormatError(f"Expected one channel of 0 to 65535 DN in {path}, found something else. Use a mosaic.")
    return np.rint(channels[0]).astype(np.uint16)
