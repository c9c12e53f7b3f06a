"""Reading a session: every file is checked for existence, checksum, shape and range before its numbers are used."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar, final

import numpy as np
from jaxtyping import Float32, UInt8, UInt16

from udccal.arguments import check_is_path, check_kind
from udccal.errors import FileFormatError, MissingStepError, SessionError
from udccal.io.exr import read_exr
from udccal.io.hashing import sha256_file
from udccal.io.limits import Shape
from udccal.io.links import is_plain_file
from udccal.io.png import read_png16, read_rgb8
from udccal.io.reading import reading
from udccal.rig import RigDescription
from udccal.sessions.manifest import read_manifest
from udccal.sessions.schema import Manifest, PanelSubject, StoredCamera, StoredCapture, StoredStep, TermName

T = TypeVar("T")


@dataclass(frozen=True)
class Average:
    """Mean in DN and unbiased variance in DN^2 of single frames, for every sample of the mosaic."""

    mean: Float32[np.ndarray, "rows columns"]
    variance: Float32[np.ndarray, "rows columns"]
    frames: int


@final
class Session:
    """A captured session on disk, open for reading. Only the manifest is kept in memory."""

    def __init__(self, path: Path, manifest: Manifest) -> None:
        """Use ``Session.open``."""
        self.path = path
        self.manifest = manifest
        self._verified: set[tuple[str, str]] = set()

    @classmethod
    def open(cls, path: str | Path) -> Session:
        """Open the session in a folder.

        Raises:
            SessionError: when there is none, or its manifest does not follow docs/session.md.
        """
        check_is_path(path, "a session", SessionError)
        folder = Path(path)
        return cls(folder, read_manifest(folder))

    @property
    def rig(self) -> RigDescription:
        """The rig as it was built to be."""
        return self.manifest.rig

    @property
    def camera(self) -> StoredCamera:
        """The camera that took the session."""
        return self.manifest.camera

    def steps(self, term: TermName) -> tuple[StoredStep, ...]:
        """Return the completed steps of a term, in the order they were captured."""
        return tuple(step for step in self.manifest.steps if step.term == term)

    def step(self, step_id: str) -> StoredStep:
        """Return a completed step by its id.

        Raises:
            MissingStepError: when it was not captured.
        """
        for step in self.manifest.steps:
            if step.id == step_id:
                return step
        raise MissingStepError(
            f"Expected the step '{step_id}' in the session {self.path}, found that it was not captured. Capture it."
        )

    def frame(self, capture: StoredCapture) -> UInt16[np.ndarray, "rows columns"]:
        """Read the single frame of a capture, in DN.

        Raises:
            SessionError: when it is an average, or the file is missing, changed, of another shape or out of range.
        """
        if capture.kind != "frame":
            raise SessionError(f"Expected '{capture.file}' of {self.path} to be a single frame, found an average.")
        data = self._read(capture.file, capture.sha256, _shape(capture), read_png16)
        self._check_range(capture, float(data.max()))
        return data

    def average(self, capture: StoredCapture) -> Average:
        """Read the average of a capture.

        Raises:
            SessionError: when it is a single frame, or the file is missing, changed, of another shape or out of range.
        """
        if capture.kind != "average":
            raise SessionError(f"Expected '{capture.file}' of {self.path} to be an average, found a single frame.")
        channels = self._read(capture.file, capture.sha256, _shape(capture), read_exr)
        if set(channels) != {"mean", "variance"}:
            raise SessionError(
                f"Expected the channels mean and variance in '{capture.file}' of {self.path}, "
                f"found {', '.join(sorted(channels))}. Write it as docs/session.md says."
            )
        mean, variance = channels["mean"], channels["variance"]
        self._check_range(capture, float(mean.max()))
        if float(min(mean.min(), variance.min())) < 0:
            raise SessionError(f"Expected no negative values in '{capture.file}' of {self.path}, found some.")
        return Average(mean, variance, capture.frames)

    def picture(self, subject: PanelSubject) -> UInt8[np.ndarray, "panel_rows panel_columns 3"]:
        """Read the picture that the panel showed, 8-bit RGB at the panel's resolution.

        Raises:
            SessionError: when the file is missing, changed or of another size.
        """
        panel = self.rig.panel
        return self._read(subject.picture, subject.picture_sha256, (panel.rows, panel.columns), read_rgb8)

    def _read(self, name: str, sha256: str, shape: Shape, reader: Callable[[Path, Shape], T]) -> T:
        file = self.path / name
        if not is_plain_file(self.path, file):
            raise SessionError(
                f"Expected the file '{name}' inside the session {self.path}, found none. Restore it, or capture again."
            )
        if (name, sha256) not in self._verified:
            found = _checksum(file)
            if found != sha256:
                raise SessionError(
                    f"Expected '{name}' of {self.path} to have the SHA-256 {sha256[:12]}..., found {found[:12]}...: "
                    "the file was changed or damaged. Restore it, or capture again, which captures that step alone."
                )
            self._verified.add((name, sha256))
        try:
            return reader(file, shape)
        except FileFormatError as error:
            raise SessionError(str(error)) from error

    def _check_range(self, capture: StoredCapture, largest: float) -> None:
        limit = self.rig.saturation_DN
        if largest > limit:
            raise SessionError(
                f"Expected samples of at most {limit} DN in '{capture.file}' of {self.path} ({self.rig.camera.bits} "
                f"bits), found {largest:g}. Store them right-aligned, as the converter delivers them."
            )


def _shape(capture: StoredCapture) -> Shape:
    return capture.region.rows, capture.region.columns


def _checksum(file: Path) -> str:
    try:
        with reading(file, SessionError):
            return sha256_file(file)
    except FileFormatError as error:  # too large
        raise SessionError(str(error)) from error


def check_session(value: object) -> None:
    """Refuse what is no session, such as its path.

    Raises:
        SessionError: which says how to open one.
    """
    check_kind(value, Session, "Open a folder by udccal.Session.open(path).", SessionError)
