"""Writing a session: first the files, each whole or absent, then the manifest that names them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence, Set
from contextlib import suppress
from datetime import UTC, datetime
from itertools import chain, count
from pathlib import Path
from types import TracebackType
from typing import Literal, final

import numpy as np
from filelock import FileLock
from jaxtyping import UInt8
from pydantic import ValidationError

from udccal.cameras.protocol import CameraIdentity
from udccal.errors import SessionError
from udccal.io.links import is_plain_file
from udccal.rig import RigDescription
from udccal.sessions.captured import Capture
from udccal.sessions.changes import Exchanged, admit, stored_camera
from udccal.sessions.damage import Damage, find_damage, named_files, remove_leftovers
from udccal.sessions.lock import lock_session
from udccal.sessions.manifest import MANIFEST_NAME, PREVIOUS_NAME, keep_previous, write_manifest
from udccal.sessions.opening import check_new, read_or_recover, sentences
from udccal.sessions.placing import place_capture, place_picture
from udccal.sessions.schema import Manifest, PanelSubject, StoredStep, Subject, TermName

Now = Callable[[], datetime]


def utc_now() -> datetime:
    """Return the time of day; a simulated rig has its own clock."""
    return datetime.now(UTC)


@final
class SessionWriter:
    """Adds completed steps to a session on disk, as its only writer; the manifest on disk is correct after every call.

    The session holds every step that ``add_step`` returned from, each once, however and whenever the process ends. Use
    it as a context manager, or ``close`` it, to let others write to the session.

    Attributes:
        damage: files found missing or changed when the session was opened; their steps count as not captured.
        recovered: whether the manifest was damaged and replaced by the one before the last step.
        again: captured steps to capture once more; each stays until its new captures are whole.
        added: ids of the steps that this writer has stored.
    """

    def __init__(
        self, path: Path, manifest: Manifest, lock: FileLock, now: Now, damage: tuple[Damage, ...], recovered: bool
    ) -> None:
        """Use ``create``, ``resume`` or ``create_or_resume``."""
        self.path = path
        self.manifest = manifest
        self.damage = damage
        self.recovered = recovered
        self._lock = lock
        self._now = now
        self.again: frozenset[str] = frozenset()
        self.added: set[str] = set()
        self._invalid = {item.step_id for item in damage}

    @classmethod
    def create(cls, path: str | Path, rig: RigDescription, camera: CameraIdentity, now: Now = utc_now) -> SessionWriter:
        """Begin a session in a new or empty folder.

        Raises:
            SessionError: when the folder holds anything, cannot be written to, or another process begins one there.
        """
        folder = Path(path)
        check_new(folder)
        with sentences("a session", folder):
            folder.mkdir(parents=True, exist_ok=True)
            lock = lock_session(folder)
        try:
            check_new(folder)
            remove_leftovers(folder)
            manifest = Manifest(
                format="udccal-session", version=1, created_at=_time(now), rig=rig, camera=stored_camera(camera)
            )
            with sentences("a session", folder):
                write_manifest(folder, manifest)
        except BaseException:
            lock.release()
            raise
        return cls(folder, manifest, lock, now, (), recovered=False)

    @classmethod
    def resume(cls, path: str | Path, now: Now = utc_now) -> SessionWriter:
        """Continue a session; steps that its manifest names and whose files are whole count as completed.

        Every file is read and compared with its checksum. Half-written files of a killed process are removed.

        Raises:
            SessionError: when there is no session, another process writes to it, or its manifest does not follow
                docs/session.md and there is no earlier one.
        """
        folder = Path(path)
        if not any((folder / name).is_file() for name in (MANIFEST_NAME, PREVIOUS_NAME)):
            raise SessionError(f"Expected a session at {folder}, found none. Check the path, or begin one.")
        lock = lock_session(folder)
        try:
            manifest, recovered = read_or_recover(folder)
            with sentences("a session", folder):
                remove_leftovers(folder)
                damage = find_damage(folder, manifest)
        except BaseException:
            lock.release()
            raise
        return cls(folder, manifest, lock, now, damage, recovered)

    @classmethod
    def create_or_resume(
        cls,
        path: str | Path,
        rig: RigDescription,
        camera: CameraIdentity,
        accepted: Set[Exchanged] = frozenset(),
        now: Now = utc_now,
    ) -> SessionWriter:
        """Continue the session in a folder if there is one of this rig and camera, else begin one.

        Args:
            path: the session's folder.
            rig: the present rig description.
            camera: the present camera.
            accepted: parts that a person exchanged on purpose since the session was begun.
            now: function that returns the time of day.

        Raises:
            SessionError: when the folder holds something else, or a session of another rig, camera or lens.
        """
        if not any((Path(path) / name).exists() for name in (MANIFEST_NAME, PREVIOUS_NAME)):
            return cls.create(path, rig, camera, now)
        writer = cls.resume(path, now)
        try:
            manifest = admit(writer.path, writer.manifest, rig, camera, accepted)
            if manifest is not writer.manifest:
                writer._write(manifest)
        except BaseException:
            writer.close()
            raise
        return writer

    def __enter__(self) -> SessionWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Let others write to the session."""
        self._lock.release()

    @property
    def completed_ids(self) -> frozenset[str]:
        """Ids of the steps that need not be captured again."""
        return frozenset(step.id for step in self.manifest.steps) - self._invalid - self.again

    def capture_again(self, step_ids: Collection[str]) -> None:
        """Have captured steps captured once more.

        Raises:
            SessionError: when one of them was not captured.
        """
        for step_id in step_ids:
            if self.step(step_id) is None:
                raise SessionError(
                    f"Expected captured steps of {self.path} to capture again, found that '{step_id}' was not "
                    "captured. Leave it out: missing steps are captured anyway."
                )
        self.again = self.again.union(step_ids)

    def keep_captured(self, step_ids: Collection[str]) -> None:
        """Leave captured steps as they are, after all, where they were to be captured once more."""
        self.again -= frozenset(step_ids)

    def step(self, step_id: str) -> StoredStep | None:
        """Return a step that was captured (its files may be damaged), or None."""
        return next((step for step in self.manifest.steps if step.id == step_id), None)

    def number(self, step_id: str) -> int:
        """Return the index of a step in the session from 0: its own, or the next free one."""
        ids = [step.id for step in self.manifest.steps]
        return ids.index(step_id) if step_id in ids else len(ids)

    def store_picture(
        self,
        step_id: str,
        picture: UInt8[np.ndarray, "panel_rows panel_columns 3"],
        role: Literal["white", "picture", "brightened"],
    ) -> PanelSubject:
        """Store the picture that the panel shows during a step, and return the subject with which to add the step.

        Raises:
            SessionError: when the id does not fit docs/session.md, or the disk is full or cannot be written to.
        """
        with sentences(f"the picture of the step '{step_id}'", self.path):
            return place_picture(self.path, self._stem(step_id), picture, role)

    def add_step(
        self,
        step_id: str,
        term: TermName,
        subject: Subject,
        captures: Sequence[Capture],
        without: Collection[str] = (),
    ) -> StoredStep:
        """Store a completed step's captures and name them in the manifest.

        A step of this id that is damaged, or to be captured again, is replaced.

        Args:
            step_id: id of the step.
            term: its term.
            subject: what stood before the camera.
            captures: its frames and averages.
            without: steps that are left out from now on, since they do not go with the new one.

        Raises:
            SessionError: when the step is already captured, does not follow docs/session.md, or the disk is full or
                cannot be written to. The session stays as it was.
        """
        if step_id in self.completed_ids:
            raise SessionError(f"Expected a new step in {self.path}, found '{step_id}' already captured. Skip it.")
        try:
            with sentences(f"the step '{step_id}'", self.path):
                step = StoredStep(
                    id=step_id,
                    term=term,
                    subject=subject,
                    completed_at=_time(self._now),
                    after_changes=len(self.manifest.changes),
                    captures=tuple(
                        place_capture(self.path, f"{self._stem(step_id)}_{index}", capture)
                        for index, capture in enumerate(captures)
                    ),
                )
            steps = tuple(each for each in self._steps_with(step) if each.id not in without)
            manifest = Manifest.model_validate(dict(self.manifest) | {"steps": steps})
        except ValidationError as error:
            raise SessionError(f"Expected the step '{step_id}' to fit docs/session.md, found: {error}") from error
        self._replace(manifest)
        self._invalid.discard(step_id)
        self.again -= {step_id, *without}
        self.added.add(step_id)
        return step

    def drop(self, step_ids: Collection[str]) -> None:
        """Leave captured steps out from now on, of which it has turned out that they are wrong; others are ignored.

        Raises:
            SessionError: when the disk is full or cannot be written to. The session stays as it was.
        """
        steps = tuple(each for each in self.manifest.steps if each.id not in step_ids)
        if len(steps) < len(self.manifest.steps):
            self._replace(self.manifest.model_copy(update={"steps": steps}))
            self.again -= frozenset(step_ids)

    def _stem(self, step_id: str) -> str:
        """Return how the names of a step's files begin: not as those of a whole step that is to be replaced."""
        if step_id not in self.again or step_id in self._invalid:
            return step_id
        used = _files(self.manifest)
        stems = chain((step_id,), (f"{step_id}-{number}" for number in count(2)))
        return next(stem for stem in stems if not any(name.startswith(f"{stem}_") for name in used))

    def _steps_with(self, step: StoredStep) -> tuple[StoredStep, ...]:
        steps, number = self.manifest.steps, self.number(step.id)
        return (*steps[:number], step, *steps[number + 1 :])

    def _replace(self, manifest: Manifest) -> None:
        """Write another manifest, and remove the files that it no longer names."""
        before = self.manifest
        self._write(manifest)
        for name in _files(before) - _files(manifest):
            file = self.path / name
            if is_plain_file(self.path, file):  # what is behind a link is not the session's
                with suppress(OSError):  # a file that stays does no harm
                    file.unlink()

    def _write(self, manifest: Manifest) -> None:
        with sentences("the manifest", self.path):
            keep_previous(self.path)
            write_manifest(self.path, manifest)
        self.manifest = manifest


def _files(manifest: Manifest) -> frozenset[str]:
    return frozenset(name for step in manifest.steps for name, _ in named_files(step))


def _time(now: Now) -> str:
    return now().isoformat(timespec="seconds")
