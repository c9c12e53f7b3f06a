"""The one protocol behind which every camera stands."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from types import TracebackType
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt16


@dataclass(frozen=True)
class CameraIdentity:
    """Which camera this is; a session belongs to one."""

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


@dataclass(frozen=True)
class Settings:
    """What the camera is asked to do, or what it accepted."""

    exposure_s: float
    gain_dB: float
    region: Region


@dataclass(frozen=True)
class Frame:
    """One frame with the settings it was really taken with; ``data`` is the caller's own copy, in DN."""

    data: UInt16[np.ndarray, "rows columns"]
    settings: Settings
    timestamp_s: float
    frame_id: int
    complete: bool


@runtime_checkable
class Camera(Protocol):
    """A source of raw mosaics, used as a context manager."""

    @property
    def identity(self) -> CameraIdentity: ...

    @property
    def sensor(self) -> Region:
        """The whole sensor."""
        ...

    @property
    def cfa(self) -> str:
        """CFA pattern of the whole sensor's top-left 2 x 2, e.g. ``RGGB``."""
        ...

    @property
    def bits(self) -> int:
        """Bits per sample."""
        ...

    def __enter__(self) -> Camera: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def configure(self, settings: Settings) -> Settings:
        """Ask for settings; returns what the device accepted. Raises CameraError when it refuses."""
        ...

    def frames(self, count: int) -> Iterator[Frame]:
        """Deliver ``count`` frames one at a time. Raises CameraError on a time-out."""
        ...
