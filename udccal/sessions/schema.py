"""The manifest of a session, ``session.json``, version 1. docs/session.md says the same to other programs."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from udccal.rig import RigDescription

TermName = Literal["noise", "geometry", "wire", "psf", "backscatter"]
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
RelativePath = Annotated[str, Field(pattern=r"^[A-Za-z0-9_\-]+(/[A-Za-z0-9_\-]+)*\.(png|exr)$", max_length=200)]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class StoredRegion(_Strict):
    """The part of the sensor a frame covers; ``x`` and ``y`` are even so that the CFA pattern is the sensor's own."""

    x: Annotated[int, Field(ge=0, multiple_of=2)]
    y: Annotated[int, Field(ge=0, multiple_of=2)]
    columns: Annotated[int, Field(ge=2, le=16384)]
    rows: Annotated[int, Field(ge=2, le=16384)]


class Rejection(_Strict):
    """Frames left out of a capture, with the reason a person can read."""

    reason: Annotated[str, Field(max_length=200)]
    frames: Annotated[int, Field(ge=1)]


class StoredCapture(_Strict):
    """One file of camera data: a single frame (16-bit PNG) or an average (EXR with ``mean`` and ``variance``).

    ``variance`` is the unbiased sample variance of single frames (not of their mean), in DN^2.
    """

    kind: Literal["frame", "average"]
    file: RelativePath
    sha256: Sha256
    frames: Annotated[int, Field(ge=1)]
    exposure_s: Annotated[float, Field(gt=0)]
    gain_dB: float
    region: StoredRegion
    first_timestamp_s: float
    last_timestamp_s: float
    rejected: tuple[Rejection, ...] = ()


class DarkSubject(_Strict):
    """No light."""

    kind: Literal["dark"] = "dark"


class FlatSubject(_Strict):
    """An even white field."""

    kind: Literal["flat"] = "flat"


class LedSubject(_Strict):
    """A small LED; the position is where a person aimed for, the fit finds where it was."""

    kind: Literal["led"] = "led"
    x_px: float
    y_px: float
    distance_mm: Annotated[float, Field(gt=0)]
    diameter_mm: Annotated[float, Field(gt=0)]


class BoardSubject(_Strict):
    """A ChArUco board somewhere in view, or (``parallel_to_panel``) on the jig that holds it parallel to the panel."""

    kind: Literal["board"] = "board"
    columns: Annotated[int, Field(ge=2, le=100)]
    rows: Annotated[int, Field(ge=2, le=100)]
    square_mm: Annotated[float, Field(gt=0)]
    marker_mm: Annotated[float, Field(gt=0)]
    dictionary: Annotated[str, Field(max_length=40)]
    parallel_to_panel: bool


class PanelSubject(_Strict):
    """Blackout with the panel showing a picture, stored as 8-bit RGB PNG at the panel's resolution."""

    kind: Literal["panel"] = "panel"
    picture: RelativePath
    picture_sha256: Sha256
    role: Literal["white", "picture", "brightened"]


Subject = Annotated[
    DarkSubject | FlatSubject | LedSubject | BoardSubject | PanelSubject, Field(discriminator="kind")
]


class StoredStep(_Strict):
    """One completed step of a procedure."""

    id: Annotated[str, Field(pattern=r"^[a-z]+(/[A-Za-z0-9_\-]+)+$", max_length=120)]
    term: TermName
    subject: Subject
    completed_at: Annotated[str, Field(max_length=40)]
    captures: Annotated[tuple[StoredCapture, ...], Field(min_length=1, max_length=256)]


class StoredCamera(_Strict):
    """Which camera took the session."""

    vendor: Annotated[str, Field(max_length=100)]
    model: Annotated[str, Field(max_length=100)]
    serial: Annotated[str, Field(max_length=100)]
    backend: Annotated[str, Field(max_length=100)]


class Manifest(_Strict):
    """The whole of ``session.json``."""

    format: Literal["udccal-session"]
    version: Literal[1]
    created_at: Annotated[str, Field(max_length=40)]
    rig: RigDescription
    camera: StoredCamera
    steps: Annotated[tuple[StoredStep, ...], Field(max_length=20000)] = ()
