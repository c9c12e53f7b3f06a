"""A rig whose pictures come from files: one folder per step of a session."""

from __future__ import annotations

from pathlib import Path
from typing import Final, final

from udccal.arrangements import Arrangement, Occasion
from udccal.cameras.files import FileCamera
from udccal.cameras.picture_files.listing import pictures_in
from udccal.errors import CameraError

_MAX_FOLDERS: Final = 20_000


@final
class StepFolders:
    """Files in ``root/<step id>/`` as a camera and its stage: to arrange a step is to open its folder.

    Files must contain their exposure, or a ``frames.csv`` in their folder must. A step whose folder has no pictures
    stops the capture with a sentence that names it; the session continues from there when they have been added.

    Attributes:
        camera: its user opens it; it begins with the files of the first folder by name.
    """

    def __init__(self, root: str | Path, cfa: str = "RGGB", bits: int = 16) -> None:
        """Find the folders; ``cfa`` and ``bits`` are those of files that do not contain theirs.

        Raises:
            CameraError: when there are no pictures in any folder two levels down, or they do not contain an exposure.
            FileFormatError: when the first one cannot be read.
        """
        self._root = Path(root)
        self.camera = FileCamera(_first_with_pictures(self._root), cfa, bits, exposure_s=None)

    def arrange(self, arrangement: Arrangement, occasion: Occasion) -> None:
        """Give the camera the files of a step.

        Raises:
            CameraError: when there are none, or they are another camera's.
        """
        folder = self._root / occasion.step_id
        if not folder.is_dir() or not pictures_in(folder):
            raise CameraError(
                f"Expected the pictures of the step {occasion.step_id} in {folder}, found none. "
                f"{occasion.instruction} Put the files there and run the same command again."
            )
        self.camera.load(folder)


def _first_with_pictures(root: Path) -> Path:
    folders = sorted(path for number, path in enumerate(root.glob("*/*/")) if number < _MAX_FOLDERS)
    for folder in folders:
        if pictures_in(folder):
            return folder
    raise CameraError(
        f"Expected pictures in folders {root}/<term>/<step>, such as {root}/wire/flat, found none. "
        "Put the files of at least one step there."
    )
