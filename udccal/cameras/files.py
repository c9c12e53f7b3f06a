"""Files as a camera: camera raw files (DNG and others), 16-bit PNG or TIFF, or EXR, one frame after the other."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Final, final

from udccal.cameras.checks import check_mode, check_region, not_open, superseded
from udccal.cameras.format_names import unpacked_format_name
from udccal.cameras.picture_files.facts import Facts, read_facts
from udccal.cameras.picture_files.listing import ListedPicture, list_files
from udccal.cameras.picture_files.mosaics import Layout, read_mosaic
from udccal.cameras.picture_files.sidecar import list_folder
from udccal.cameras.protocol import CameraIdentity, Counts, Features, Frame, Mode, Range, Region, Settings, Trigger
from udccal.cfa import PATTERNS
from udccal.errors import CameraError

Source = str | Path | Sequence[str | Path]

FILES: Final = "files"  # the backend by which a session names this camera
_STEPS: Final = (2, 2, 2, 2)


@final
@dataclass(frozen=True)
class _Shot:
    """A file with its settings."""

    path: Path
    exposure_s: float
    gain_dB: float
    taken_s: float


@final
class FileCamera:
    """Implements ``udccal.cameras.protocol.Camera`` on files of one size, taken by one camera.

    A file's exposure comes from the ``frames.csv`` in its folder, else from the file itself. Its gain is relative to
    the first file's: 20 log10 of the ratio of their ISO values, since no file gives the sensor's native ISO.
    ``configure`` chooses the files whose gain, then exposure, comes nearest, and begins with the first of these.
    """

    def __init__(self, source: Source, cfa: str = "RGGB", bits: int = 16, exposure_s: float | None = 1.0) -> None:
        """List a folder, or files in the order of the frames, and read the first one.

        Args:
            source: a folder, with or without a ``frames.csv``, or a list of files.
            cfa: pattern of PNG, TIFF and EXR files, ``mono`` for none; raw files contain their own.
            bits: bits per sample of PNG, TIFF and EXR files.
            exposure_s: exposure of files that do not contain it; None to refuse these.

        Raises:
            CameraError: when there are no files, one does not contain its exposure and ``exposure_s`` is None, or
                ``exposure_s`` is no exposure.
            FileFormatError: when a file cannot be read.
        """
        if exposure_s is not None and not 0 < exposure_s < math.inf:
            raise CameraError(
                f"Expected an exposure above 0 s for files that do not contain theirs, found {exposure_s:g} s. Use 1 s."
            )
        self._layout, self._exposure_s = _layout(cfa, bits), exposure_s
        listed = _listed(source)
        self._maker = facts = read_facts(listed[0].path)
        self._identity = _identity(facts, listed[0].path)
        first = read_mosaic(listed[0].path, self._layout)
        rows, columns = (2 * (side // 2) for side in first.data.shape)  # regions of whole 2 x 2 cells
        self._shape, self._cfa, self._bits = first.data.shape, first.cfa, first.bits
        self._sensor = Region(0, 0, columns, rows)
        self._mode = Mode(unpacked_format_name(self._cfa, self._bits))
        self._region, self._counts, self._taken_s = self._sensor, Counts(), -math.inf
        self._open, self._stream = False, 0
        self._shots = self._queue = tuple(self._shot(item) for item in listed)
        self._next = 0

    @property
    def identity(self) -> CameraIdentity:
        """Camera that took the first file."""
        return self._identity

    @property
    def sensor(self) -> Region:
        """Whole CFA cells of the first file."""
        return self._sensor

    @property
    def cfa(self) -> str:
        """Pattern of the top-left 2 x 2."""
        return self._cfa

    @property
    def bits(self) -> int:
        """Bits that hold the saturation level."""
        return self._bits

    @property
    def features(self) -> Features:
        """Exposures and gains of the files; files have no rate and no trigger."""
        exposures = [shot.exposure_s for shot in self._shots]
        gains = [shot.gain_dB for shot in self._shots]
        return Features(
            exposure_s=Range(min(exposures), max(exposures)),
            gain_dB=Range(min(gains), max(gains)),
            frame_rate_hz=Range(0.0, 0.0),
            pixel_formats=(unpacked_format_name(self._cfa, self._bits),),
            triggers=(Trigger.FREE_RUN,),
            region_steps=_STEPS,
        )

    @property
    def mode(self) -> Mode:
        """The only mode."""
        return self._mode

    @property
    def counts(self) -> Counts:
        """Frames since it was opened."""
        return self._counts

    def __enter__(self) -> FileCamera:
        """Begin with the first file."""
        self._open, self._next, self._queue = True, 0, self._shots
        self._counts, self._taken_s = Counts(), -math.inf
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """No file is held open between frames."""
        self._open = False
        self._stream += 1

    def load(self, source: Source) -> None:
        """Replace the files by others of the same camera, such as those of a session's next step.

        Raises:
            CameraError: when there are none, or they are another camera's.
            FileFormatError: when the fields of one cannot be read.
        """
        shots = tuple(self._shot(item) for item in _listed(source))
        self._shots = self._queue = shots
        self._next, self._taken_s = 0, -math.inf
        self._stream += 1

    def set_mode(self, mode: Mode) -> Mode:
        """Accept the only mode.

        Raises:
            CameraError: when it is another one, or the camera is closed.
        """
        self._check_open()
        check_mode(mode, self.features)
        self._stream += 1
        return self._mode

    def configure(self, settings: Settings) -> Settings:
        """Choose a region and the files nearest in gain and exposure, and begin with the first of these.

        Raises:
            CameraError: when the region is not inside the picture or not aligned to the pattern, the exposure or gain
                is not a number, or the camera is closed.
        """
        self._check_open()
        check_region(settings.region, self._sensor, _STEPS)
        if not (0 < settings.exposure_s < math.inf and math.isfinite(settings.gain_dB)):
            raise CameraError(
                f"Expected an exposure above 0 s and a gain in dB, found {settings.exposure_s:g} s and "
                f"{settings.gain_dB:g} dB. Ask for the nearest that the files have."
            )
        self._region = settings.region
        best = min(self._shots, key=lambda shot: _distance(shot, settings))
        chosen = (best.gain_dB, best.exposure_s)
        self._queue = tuple(shot for shot in self._shots if (shot.gain_dB, shot.exposure_s) == chosen)
        self._next, self._taken_s = 0, -math.inf
        self._stream += 1
        return Settings(best.exposure_s, best.gain_dB, settings.region)

    def frames(self, count: int) -> Iterator[Frame]:
        """Deliver the next files, one at a time.

        Raises:
            CameraError: when the files are used up, one has another size or pattern than the first, or the camera is
                closed.
            FileFormatError: when one cannot be read.
        """
        self._check_open()
        self._stream += 1
        return self._deliver(count, self._stream)

    def _check_open(self) -> None:
        if not self._open:
            raise not_open()

    def _deliver(self, count: int, stream: int) -> Iterator[Frame]:
        for _ in range(count):
            if self._stream != stream:
                raise superseded()
            if self._next >= len(self._queue):
                raise CameraError(
                    f"Expected {count} more frames at this setting, found that all {len(self._queue)} files are used. "
                    "Take more, or ask for fewer."
                )
            shot, self._next = self._queue[self._next], self._next + 1
            yield self._frame(shot)

    def _frame(self, shot: _Shot) -> Frame:
        mosaic = read_mosaic(shot.path, self._layout)
        if mosaic.data.shape != self._shape or mosaic.cfa != self._cfa or int(mosaic.data.max()) >> self._bits:
            raise CameraError(
                f"Expected {shot.path} to have the size, pattern and bits of the first file, found another. "
                "Take the files of one camera."
            )
        region = self._region
        data = mosaic.data[region.y : region.y + region.rows, region.x : region.x + region.columns].copy()
        self._taken_s = max(self._taken_s, shot.taken_s)  # copied files may have times out of order
        number, self._counts = self._counts.delivered, Counts(self._counts.delivered + 1)
        return Frame(data, Settings(shot.exposure_s, shot.gain_dB, region), self._taken_s, number, True)

    def _shot(self, listed: ListedPicture) -> _Shot:
        facts = read_facts(listed.path)
        first = self._maker
        if (facts.vendor, facts.model, facts.serial) != (first.vendor, first.model, first.serial):
            raise CameraError(
                f"Expected files of one camera ({_name(first)}), found {listed.path} by another ({_name(facts)}). "
                "Take the files of one camera."
            )
        exposure_s = next((s for s in (listed.exposure_s, facts.exposure_s, self._exposure_s) if s is not None), None)
        if exposure_s is None:
            raise CameraError(
                f"Expected the exposure of {listed.path} in the file or in a frames.csv in its folder, found neither. "
                "Write a frames.csv."
            )
        ratio = facts.iso / first.iso if facts.iso and first.iso else 1.0
        gain_dB = listed.gain_dB if listed.gain_dB is not None else 20.0 * math.log10(ratio)
        taken_s = next((s for s in (listed.timestamp_s, facts.taken_s) if s is not None), None)
        return _Shot(listed.path, exposure_s, gain_dB, listed.path.stat().st_mtime if taken_s is None else taken_s)


def _layout(cfa: str, bits: int) -> Layout:
    if cfa not in PATTERNS or not 1 <= bits <= 16:
        raise CameraError(
            f"Expected a pattern of {', '.join(PATTERNS)} and 1 to 16 bits, found {cfa[:20]!r} and {bits}. "
            "Take them from the camera's data sheet."
        )
    return Layout(cfa, bits)


def _listed(source: Source) -> tuple[ListedPicture, ...]:
    return list_folder(Path(source)) if isinstance(source, str | Path) else list_files(source)


def _name(facts: Facts) -> str:
    return " ".join(text for text in (facts.vendor, facts.model, facts.serial) if text) or "none stated"


def _identity(facts: Facts, path: Path) -> CameraIdentity:
    """Return the camera of a file; all files without one share it, so that a session can continue with other files."""
    model = facts.model or path.suffix.lower().lstrip(".") or "unnamed"
    return CameraIdentity(facts.vendor or "files", model, facts.serial or "not stated", FILES)


def _distance(shot: _Shot, settings: Settings) -> tuple[float, float]:
    return abs(shot.gain_dB - settings.gain_dB), abs(math.log(shot.exposure_s / settings.exposure_s))
