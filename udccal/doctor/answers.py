"""Answers of the doctor's child processes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

from pydantic import TypeAdapter


@final
@dataclass(frozen=True)
class SeenCamera:
    """A camera that a backend lists.

    Attributes:
        name: maker, model and serial.
        too_slow: whether its port is slower than the camera supports, as far as the backend knows.
        trouble: why it cannot be opened, as a sentence; empty when no reason is known.
        serial: its serial number; empty when it cannot be read.
    """

    name: str
    too_slow: bool = False
    trouble: str = ""
    serial: str = ""


@final
@dataclass(frozen=True)
class OpenedCamera:
    """A camera that was opened for a rig.

    Attributes:
        columns, rows: its whole sensor.
        rate_hz: highest frame rate.
        shortest_s, longest_s: exposures.
        refusal: why it has no mode with the rig's pattern and bits, as a sentence; empty when it has.
    """

    columns: int
    rows: int
    rate_hz: float
    shortest_s: float
    longest_s: float
    refusal: str = ""


@final
@dataclass(frozen=True)
class JaxDevice:
    """A device that JAX computes on: its platform (cpu, gpu, tpu) and kind."""

    platform: str
    kind: str


@final
@dataclass(frozen=True)
class Failure:
    """The reason for a missing answer.

    Attributes:
        reason: a phrase; when ``refused``, a sentence that says what to do.
        refused: whether udccal's own code found what is missing.
    """

    reason: str
    refused: bool = False


def read_cameras(content: bytes) -> tuple[SeenCamera, ...]:
    """Read cameras from JSON.

    Raises:
        pydantic.ValidationError: when the JSON holds something else.
    """
    return TypeAdapter(tuple[SeenCamera, ...]).validate_json(content, strict=True)


def read_opened(content: bytes) -> tuple[OpenedCamera]:
    """From JSON; errors as ``read_cameras``."""
    return TypeAdapter(tuple[OpenedCamera]).validate_json(content, strict=True)


def read_devices(content: bytes) -> tuple[JaxDevice, ...]:
    """From JSON; errors as ``read_cameras``."""
    return TypeAdapter(tuple[JaxDevice, ...]).validate_json(content, strict=True)


def read_failure(content: bytes) -> Failure:
    """From JSON; errors as ``read_cameras``."""
    return TypeAdapter(Failure).validate_json(content, strict=True)
