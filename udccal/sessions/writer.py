"""Writing a session: files first, each whole or absent, then the manifest that names them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal, final

import numpy as np
from jaxtyping import UInt8
from pydantic import ValidationError

from udccal.cameras.protocol import CameraIdentity, Frame, Region
from udccal.errors import SessionError
from udccal.io.exr import write_exr
from udccal.io.hashing import sha256_file
from udccal.io.png import write_png16, write_rgb8
from udccal.rig import RigDescription
from udccal.sessions.averaging import AveragedFrames
from udccal.sessions.manifest import MANIFEST_NAME, read_manifest, write_manifest
from udccal.sessions.schema import (
    RELATIVE_PATH,
    Manifest,
    PanelSubject,
    StoredCamera,
    StoredCapture,
    StoredRegion,
    StoredStep,
    Subject,
    TermName,
)


@final
class SessionWriter:
    """Adds completed steps to a session on disk; the manifest on disk is true after every call.

    Surviving a crash in the middle of a step, and telling its leftovers apart, has its place in ``resume``.
    """

    def __init__(self, path: Path, manifest: Manifest) -> None:
        """Use ``create``, ``resume`` or ``create_or_resume``."""
        self.path = path
        self.manifest = manifest

    @classmethod
    def create(cls, path: str | Path, rig: RigDescription, camera: CameraIdentity) -> SessionWriter:
        """Begin a session in a new or empty folder.

        Raises:
            SessionError: when the folder holds anything.
        """
        folder = Path(path)
        if (folder / MANIFEST_NAME).exists():
            raise SessionError(f"Expected no session at {folder}, found one. Resume it, or choose another folder.")
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise SessionError(
                f"Expected {folder} to be a new or empty folder, found other content. Choose another folder."
            )
        folder.mkdir(parents=True, exist_ok=True)
        manifest = Manifest(
            format="udccal-session", version=1, created_at=_now(), rig=rig, camera=_stored_camera(camera)
        )
        write_manifest(folder, manifest)
        return cls(folder, manifest)

    @classmethod
    def resume(cls, path: str | Path) -> SessionWriter:
        """Go on with a session; steps that its manifest names count as completed.

        Raises:
            SessionError: when there is none, or its manifest does not follow docs/session.md.
        """
        folder = Path(path)
        return cls(folder, read_manifest(folder))

    @classmethod
    def create_or_resume(cls, path: str | Path, rig: RigDescription, camera: CameraIdentity) -> SessionWriter:
        """Go on with the session in a folder if there is one of this rig and camera, else begin one.

        Raises:
            SessionError: when the folder holds something else, or a session of another rig or camera.
        """
        if not (Path(path) / MANIFEST_NAME).exists():
            return cls.create(path, rig, camera)
        writer = cls.resume(path)
        if writer.manifest.rig != rig:
            raise SessionError(
                f"Expected the session {path} to be of the rig '{rig.name}' as described now, found another one "
                f"('{writer.manifest.rig.name}'). Begin a new session."
            )
        if writer.manifest.camera != _stored_camera(camera):
            raise SessionError(
                f"Expected the session {path} to be of camera {camera.model} {camera.serial}, found "
                f"{writer.manifest.camera.model} {writer.manifest.camera.serial}. Begin a new session."
            )
        return writer

    @property
    def completed_ids(self) -> frozenset[str]:
        """Ids of the steps that need not be captured again."""
        return frozenset(step.id for step in self.manifest.steps)

    def step(self, step_id: str) -> StoredStep | None:
        """A completed step, or None."""
        return next((step for step in self.manifest.steps if step.id == step_id), None)

    def store_picture(
        self,
        step_id: str,
        picture: UInt8[np.ndarray, "panel_rows panel_columns 3"],
        role: Literal["white", "picture", "brightened"],
    ) -> PanelSubject:
        """Store what the panel shows during a step, before the step is added with the subject returned."""
        name = f"{step_id}_shown.png"
        write_rgb8(self._place(name), picture)
        return PanelSubject(picture=name, picture_sha256=sha256_file(self.path / name), role=role)

    def add_step(
        self, step_id: str, term: TermName, subject: Subject, captures: Sequence[Frame | AveragedFrames]
    ) -> StoredStep:
        """Store a completed step's captures and name them in the manifest.

        Raises:
            SessionError: when the step is there already, or does not fit docs/session.md.
        """
        if step_id in self.completed_ids:
            raise SessionError(f"Expected a new step in {self.path}, found '{step_id}' captured already. Skip it.")
        try:
            step = StoredStep(
                id=step_id,
                term=term,
                subject=subject,
                completed_at=_now(),
                captures=tuple(self._store(f"{step_id}_{index}", capture) for index, capture in enumerate(captures)),
            )
            manifest = Manifest.model_validate(dict(self.manifest) | {"steps": (*self.manifest.steps, step)})
        except ValidationError as error:
            raise SessionError(f"Expected the step '{step_id}' to fit docs/session.md, found: {error}") from error
        write_manifest(self.path, manifest)
        self.manifest = manifest
        return step

    def _store(self, stem: str, capture: Frame | AveragedFrames) -> StoredCapture:
        settings = capture.settings
        if isinstance(capture, AveragedFrames):
            name, frames = f"{stem}.exr", capture.frames
            first, last, rejected = capture.first_timestamp_s, capture.last_timestamp_s, capture.rejected
            write_exr(self._place(name), {"mean": capture.mean, "variance": capture.variance})
        else:
            name, frames = f"{stem}.png", 1
            first, last, rejected = capture.timestamp_s, capture.timestamp_s, ()
            write_png16(self._place(name), capture.data)
        return StoredCapture(
            kind="average" if isinstance(capture, AveragedFrames) else "frame",
            file=name,
            sha256=sha256_file(self.path / name),
            frames=frames,
            exposure_s=settings.exposure_s,
            gain_dB=settings.gain_dB,
            region=_stored_region(settings.region),
            first_timestamp_s=first,
            last_timestamp_s=last,
            rejected=rejected,
        )

    def _place(self, name: str) -> Path:
        if not re.fullmatch(RELATIVE_PATH, name):
            raise SessionError(f"Expected a step id of letters, digits, '_', '-' and '/', found a file name '{name}'.")
        file = self.path / name
        file.parent.mkdir(parents=True, exist_ok=True)
        return file


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def _stored_camera(camera: CameraIdentity) -> StoredCamera:
    return StoredCamera(vendor=camera.vendor, model=camera.model, serial=camera.serial, backend=camera.backend)


def _stored_region(region: Region) -> StoredRegion:
    return StoredRegion(x=region.x, y=region.y, columns=region.columns, rows=region.rows)
