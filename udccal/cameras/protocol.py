"""The protocol that every camera implements."""

from __future__ import annotations

import enum
from collections.abc import Iterator
from dataclasses import dataclass
from types import TracebackType
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt16


@dataclass(frozen=True)
class CameraIdentity:
    """Identity of a camera; a session belongs to one camera."""

    vendor: str
    model: str
    serial: str
    backend: str


@dataclass(frozen=True)
class Region:
    """A rectangle of the sensor; ``x`` and ``y`` are the sensor coordinates of its first sample, both even."""

    x: int
    y: int
    columns: int
    rows: int


class Trigger(enum.StrEnum):
    """What starts an exposure."""

    FREE_RUN = "free-run"  # the camera's own clock
    SOFTWARE = "software"  # the driver, when a frame is requested: nothing is exposed before
    EXTERNAL = "external"  # a signal at the camera's trigger input


@dataclass(frozen=True)
class Mode:
    """How a camera works, chosen once for a session.

    Attributes:
        pixel_format: name after the GenICam Pixel Format Naming Convention, e.g. ``BayerRG12p``.
        frame_rate_hz: rate of a free-running camera; None for the fastest that exposure and link allow.
    """

    pixel_format: str
    frame_rate_hz: float | None = None
    trigger: Trigger = Trigger.FREE_RUN


@dataclass(frozen=True)
class Settings:
    """Requested settings for the next frames, or those that the camera accepted."""

    exposure_s: float
    gain_dB: float
    region: Region


@dataclass(frozen=True)
class Range:
    """Bounds, both included."""

    low: float
    high: float


@dataclass(frozen=True)
class Features:
    """What a camera can do.

    Attributes:
        region_steps: (x, y, columns, rows) of a region are multiples of these; all even, so that the CFA pattern of
            a region is the sensor's own.
    """

    exposure_s: Range
    gain_dB: Range
    frame_rate_hz: Range
    pixel_formats: tuple[str, ...]
    triggers: tuple[Trigger, ...]
    region_steps: tuple[int, int, int, int]


@dataclass(frozen=True)
class Counts:
    """Numbers of frames since the camera was opened: delivered (with incomplete ones), incomplete, and dropped."""

    delivered: int = 0
    incomplete: int = 0
    dropped: int = 0


@dataclass(frozen=True)
class Frame:
    """One frame with its true settings; ``data`` is the caller's own copy, in DN.

    Attributes:
        timestamp_s: start of the exposure on the camera's clock.
        frame_id: the camera's own count; a gap is a frame that never arrived.
        complete: False when samples are missing; those are 0.
        temperature_C: of the sensor, or of the place nearest to it that the camera measures, when the camera began to
            deliver; None where it says none.
    """

    data: UInt16[np.ndarray, "rows columns"]
    settings: Settings
    timestamp_s: float
    frame_id: int
    complete: bool
    temperature_C: float | None = None


@runtime_checkable
class Camera(Protocol):
    """A source of raw mosaics, used as a context manager; everything but ``identity`` needs an open camera."""

    @property
    def identity(self) -> CameraIdentity: ...

    @property
    def sensor(self) -> Region:
        """The whole sensor."""
        ...

    @property
    def cfa(self) -> str:
        """CFA pattern of the whole sensor's top-left 2 x 2, e.g. ``RGGB``; ``mono`` for none."""
        ...

    @property
    def bits(self) -> int:
        """Bits per sample in the current mode."""
        ...

    @property
    def features(self) -> Features:
        """What the camera can do in the current mode."""
        ...

    @property
    def mode(self) -> Mode:
        """Current mode."""
        ...

    @property
    def counts(self) -> Counts:
        """Frames since the camera was opened."""
        ...

    def __enter__(self) -> Camera: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def set_mode(self, mode: Mode) -> Mode:
        """Request a mode; return what the device accepted, read back. Raise CameraError when it refuses."""
        ...

    def configure(self, settings: Settings) -> Settings:
        """Request settings; return what the device accepted, read back. Raise CameraError when it refuses."""
        ...

    def frames(self, count: int) -> Iterator[Frame]:
        """Deliver ``count`` frames one at a time; incomplete ones are marked.

        Raises:
            CameraTimeout: when none comes within the exposure and the camera's time-out.
            CameraLost: when the camera is no longer there.
            CameraError: when it is not open, or stops in another way.
        """
        ...
