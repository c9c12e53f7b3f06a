"""What a child process of the doctor may answer."""

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
        too_slow: it is plugged into a slower port than it was made for, as far as the backend knows.
        trouble: why it cannot be opened, as a sentence; empty when nothing is known against it.
    """

    name: str
    too_slow: bool = False
    trouble: str = ""


@final
@dataclass(frozen=True)
class JaxDevice:
    """A device that JAX computes on: its platform (cpu, gpu, tpu) and kind."""

    platform: str
    kind: str


@final
@dataclass(frozen=True)
class Failure:
    """Why there is no answer.

    Attributes:
        reason: in a phrase; or, when ``refused``, in a sentence that says what to do.
        refused: udccal's own code found what is missing.
    """

    reason: str
    refused: bool = False


def read_cameras(content: bytes) -> tuple[SeenCamera, ...]:
    """From JSON.

    Raises:
        pydantic.ValidationError: when it is something else.
    """
    return TypeAdapter(tuple[SeenCamera, ...]).validate_json(content, strict=True)


def read_devices(content: bytes) -> tuple[JaxDevice, ...]:
    """From JSON; errors as ``read_cameras``."""
    return TypeAdapter(tuple[JaxDevice, ...]).validate_json(content, strict=True)


def read_failure(content: bytes) -> Failure:
    """From JSON; errors as ``read_cameras``."""
    return TypeAdapter(Failure).validate_json(content, strict=True)
