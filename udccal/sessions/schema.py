"""The manifest of a session, ``session.json``, version 1, which docs/session.md describes."""

from __future__ import annotations

from collections import Counter
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from udccal.cameras.checks import COLDEST_C, HOTTEST_C
from udccal.rig import RigDescription

TermName = Literal["noise", "geometry", "wire", "psf", "backscatter"]
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
# Exchanges of camera or lens in one session.
MOST_CHANGES = 100
RELATIVE_PATH = r"^[A-Za-z0-9_\-]+(/[A-Za-z0-9_\-]+)*\.(png|exr)$"
RelativePath = Annotated[str, Field(pattern=RELATIVE_PATH, max_length=200)]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class StoredRegion(_Strict):
    """The part of the sensor a frame covers; ``x`` and ``y`` are even so that the CFA pattern is the sensor's own."""

    x: Annotated[int, Field(ge=0, multiple_of=2)]
    y: Annotated[int, Field(ge=0, multiple_of=2)]
    columns: Annotated[int, Field(ge=2, le=16384)]
    rows: Annotated[int, Field(ge=2, le=16384)]


class Rejection(_Strict):
    """Frames left out of a capture, with a reason for a person to read."""

    reason: Annotated[str, Field(max_length=200)]
    frames: Annotated[int, Field(ge=1)]


class StoredCapture(_Strict):
    """One file of camera data: a single frame (16-bit PNG) or an average (EXR with ``mean`` and ``variance``).

    ``variance`` is the unbiased sample variance of single frames (not of their mean), in DN^2. ``temperature_C`` is
    None where the camera said none, and in sessions from before it was stored.
    """

    kind: Literal["frame", "average"]
    file: RelativePath
    sha256: Sha256
    frames: Annotated[int, Field(ge=1, le=2**20)]
    exposure_s: Annotated[float, Field(gt=0)]
    gain_dB: Annotated[float, Field(ge=-200, le=200)]
    region: StoredRegion
    first_timestamp_s: float
    last_timestamp_s: float
    rejected: tuple[Rejection, ...] = ()
    temperature_C: Annotated[float, Field(ge=COLDEST_C, le=HOTTEST_C)] | None = None

    @model_validator(mode="after")
    def _kind_fits_file(self) -> StoredCapture:
        suffix = ".png" if self.kind == "frame" else ".exr"
        if not self.file.endswith(suffix):
            raise ValueError(f"a capture of kind '{self.kind}' in a file ending in {suffix}")
        if (self.kind == "frame") != (self.frames == 1):
            raise ValueError("frames = 1 for a single frame, and at least 2 for an average")
        if self.last_timestamp_s < self.first_timestamp_s:
            raise ValueError("last_timestamp_s not before first_timestamp_s")
        return self


class DarkSubject(_Strict):
    """No light."""

    kind: Literal["dark"] = "dark"


class FlatSubject(_Strict):
    """An even white field."""

    kind: Literal["flat"] = "flat"


class LedSubject(_Strict):
    """A small LED; the position is where a person aimed, and the fit finds where it was."""

    kind: Literal["led"] = "led"
    x_px: float
    y_px: float
    distance_mm: Annotated[float, Field(gt=0)]
    diameter_mm: Annotated[float, Field(gt=0)]


class BoardSubject(_Strict):
    """A ChArUco board in view, or, with ``parallel_to_panel``, on the jig that holds it parallel to the panel."""

    kind: Literal["board"] = "board"
    columns: Annotated[int, Field(ge=2, le=100)]
    rows: Annotated[int, Field(ge=2, le=100)]
    square_mm: Annotated[float, Field(gt=0)]
    marker_mm: Annotated[float, Field(gt=0)]
    dictionary: Annotated[str, Field(max_length=40)]
    parallel_to_panel: bool


class PanelSubject(_Strict):
    """A dark room in which the panel shows a picture, stored as 8-bit RGB PNG at the panel's resolution."""

    kind: Literal["panel"] = "panel"
    picture: RelativePath
    picture_sha256: Sha256
    role: Literal["white", "picture", "brightened"]


Subject = Annotated[DarkSubject | FlatSubject | LedSubject | BoardSubject | PanelSubject, Field(discriminator="kind")]


class StoredStep(_Strict):
    """One completed step of a procedure."""

    id: Annotated[str, Field(pattern=r"^[a-z]+(/[A-Za-z0-9_\-]+)+$", max_length=120)]
    term: TermName
    subject: Subject
    completed_at: Annotated[str, Field(max_length=40)]
    after_changes: Annotated[int, Field(ge=0, le=MOST_CHANGES)] = 0
    captures: Annotated[tuple[StoredCapture, ...], Field(min_length=1, max_length=256)]

    @model_validator(mode="after")
    def _id_names_term(self) -> StoredStep:
        if not self.id.startswith(f"{self.term}/"):
            raise ValueError(f"an id that begins with '{self.term}/'")
        return self


class StoredCamera(_Strict):
    """The camera that took the session."""

    vendor: Annotated[str, Field(max_length=100)]
    model: Annotated[str, Field(max_length=100)]
    serial: Annotated[str, Field(max_length=100)]
    backend: Annotated[str, Field(max_length=100)]


class StoredChange(_Strict):
    """An exchange of the camera or the lens, after which a person continued the session."""

    what: Literal["camera", "lens"]
    before: Annotated[str, Field(max_length=300)]
    after: Annotated[str, Field(max_length=300)]


class Manifest(_Strict):
    """The whole of ``session.json``."""

    format: Literal["udccal-session"]
    version: Literal[1]
    manifest_sha256: Sha256 | None = None
    created_at: Annotated[str, Field(max_length=40)]
    rig: RigDescription
    camera: StoredCamera
    changes: Annotated[tuple[StoredChange, ...], Field(max_length=MOST_CHANGES)] = ()
    steps: Annotated[tuple[StoredStep, ...], Field(max_length=20000)] = ()

    @model_validator(mode="after")
    def _steps_fit_together(self) -> Manifest:
        repeated = [step for step, times in Counter(step.id for step in self.steps).items() if times > 1]
        if repeated:
            raise ValueError(f"each step once, not '{repeated[0]}' twice")
        for step in self.steps:
            for region in (capture.region for capture in step.captures):
                if region.x + region.columns > self.rig.camera.columns or region.y + region.rows > self.rig.camera.rows:
                    raise ValueError(f"regions inside the sensor, unlike that of step '{step.id}'")
        return self
