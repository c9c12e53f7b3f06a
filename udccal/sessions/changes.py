"""Check that a session may continue with the present camera and rig."""

from __future__ import annotations

import enum
from collections.abc import Iterator, Set
from pathlib import Path

from pydantic import ValidationError

from udccal.cameras.protocol import CameraIdentity
from udccal.errors import SessionError
from udccal.rig import RigDescription
from udccal.sessions.schema import MOST_CHANGES, Manifest, StoredCamera, StoredChange


class Exchanged(enum.StrEnum):
    """Parts that may be exchanged during a session when a person confirms it."""

    CAMERA = "camera"
    LENS = "lens"


def stored_camera(camera: CameraIdentity) -> StoredCamera:
    """Return a camera's identity in the form of the manifest.

    Raises:
        SessionError: when it does not fit there.
    """
    try:
        return StoredCamera(vendor=camera.vendor, model=camera.model, serial=camera.serial, backend=camera.backend)
    except ValidationError as error:
        first = error.errors()[0]
        raise SessionError(
            f"Expected the '{first['loc'][0]}' of the camera to be a text of at most 100 characters, found "
            f"{first['input']!r:.60}. Correct what the camera's program says of it."
        ) from error


def admit(
    path: Path, manifest: Manifest, rig: RigDescription, camera: CameraIdentity, accepted: Set[Exchanged]
) -> Manifest:
    """Return the manifest with which a session continues, with any accepted exchange added.

    Args:
        path: the session's folder, for messages.
        manifest: the manifest so far.
        rig: the present rig description.
        camera: the present camera.
        accepted: parts that a person exchanged on purpose.

    Raises:
        SessionError: when the rig differs, camera or lens differ and that was not accepted, or parts were exchanged
            too often.
    """
    check_description(path, manifest, rig)
    changes = tuple(_changes(manifest, rig, camera))
    for change in changes:
        if Exchanged(change.what) not in accepted:
            raise SessionError(
                f"Expected the session {path} to be of the {change.what} {change.after}, found {change.before}. Put "
                f"that {change.what} back, begin a new session, or confirm that the {change.what} was exchanged "
                f"(--exchanged {change.what}): earlier captures then belong to the earlier {change.what}."
            )
    if not changes:
        return manifest
    if len(manifest.changes) + len(changes) > MOST_CHANGES:
        raise SessionError(
            f"Expected at most {MOST_CHANGES} exchanges in the session {path}, found one more. Begin a new session."
        )
    update = {"rig": rig, "camera": stored_camera(camera), "changes": (*manifest.changes, *changes)}
    return manifest.model_copy(update=update)


def check_description(path: Path, manifest: Manifest, rig: RigDescription) -> None:
    """Refuse a session of a rig that is described in another way; its lens alone may differ.

    Raises:
        SessionError: when the rig differs.
    """
    if rig.model_copy(update={"lens": manifest.rig.lens}) != manifest.rig:
        raise SessionError(
            f"Expected the session {path} to be of the rig '{rig.name}' as it is described now, found another "
            f"description ('{manifest.rig.name}'). Begin a new session."
        )


def _changes(manifest: Manifest, rig: RigDescription, camera: CameraIdentity) -> Iterator[StoredChange]:
    before, after = manifest.camera, stored_camera(camera)
    # The same camera may be opened by another backend, which may spell its maker differently.
    if (before.model, before.serial) != (after.model, after.serial):
        yield StoredChange(what="camera", before=_camera_name(before), after=_camera_name(after))
    if manifest.rig.lens != rig.lens:
        yield StoredChange(what="lens", before=_lens_name(manifest.rig), after=_lens_name(rig))


def _camera_name(camera: StoredCamera) -> str:
    return f"{camera.vendor} {camera.model} {camera.serial}"[:300]


def _lens_name(rig: RigDescription) -> str:
    lens = rig.lens
    focal, stop = (f"{item.value:g} ± {item.tolerance:g}" for item in (lens.focal_mm, lens.f_number))
    values = f"{focal} mm, f/{stop}, focused at {lens.focus_mm:g} mm"
    return f"{lens.model} ({values})"[:300]
