"""OpenCV's calibration file: ``cv2.FileStorage`` reads it, under the names that OpenCV's own sample writes."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from udccal.errors import ProfileError
from udccal.profiles.exchange.format import ExportFormat, ImportFormat
from udccal.profiles.exchange.lens import Lens, Pose, lens_of, lens_with, pinhole_of
from udccal.profiles.exchange.plain_yaml import Document, read_yaml
from udccal.profiles.profile import Profile

NAME = "opencv-yaml"
_ROTATION, _PUPIL = "R_panel_camera", "pupil_mm"
# By rounding of nine numbers that were written with sixteen digits.
_ROUNDING = 1e-9


def _encode(profile: Profile) -> bytes:
    lens = lens_of(profile)
    parts = [
        "%YAML:1.0\n---\n",
        f"image_width: {lens.columns}\nimage_height: {lens.rows}\n",
        _matrix("camera_matrix", lens.matrix),
        _matrix("distortion_coefficients", lens.distortion[:, None]),
    ]
    if lens.pose is not None:
        parts += [_matrix(_ROTATION, lens.pose.R_panel_camera), _matrix(_PUPIL, lens.pose.pupil_mm[:, None])]
    return "".join(parts).encode("ascii")


def _matrix(name: str, values: Float[np.ndarray, "rows columns"]) -> str:
    rows, columns = values.shape
    data = ", ".join(repr(float(value)) for value in values.ravel())
    return f"{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: [ {data} ]\n"


def _decode(text: str, where: str) -> Lens:
    document = read_yaml(text, where)
    _refuse_fisheye(document)
    size = document.whole("image_width"), document.whole("image_height")
    pinhole = pinhole_of(where, document.matrix_of("camera_matrix", 3, 3))
    coefficients = document.matrix("distortion_coefficients").ravel()
    return lens_with(where, size, pinhole, list(coefficients), _pose(document))


def _refuse_fisheye(document: Document) -> None:
    """OpenCV's sample has one name for the coefficients of both of its models, and says which it is in an entry."""
    if "fisheye_model" in document.entries and document.word("fisheye_model") != "0":
        raise ProfileError(
            f"Expected the pinhole model of OpenCV in {document.where}, found its fisheye model. Calibrate with "
            "the pinhole model."
        )


def _pose(document: Document) -> Pose | None:
    """The pose that udccal writes; other programs' poses are of boards."""
    if not {_ROTATION, _PUPIL} <= set(document.entries):
        return None
    rotation = document.matrix_of(_ROTATION, 3, 3)
    off = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if not (off < _ROUNDING and np.linalg.det(rotation) > 0):
        raise ProfileError(
            f"Expected '{_ROTATION}' in {document.where} to be a rotation matrix, found another. Correct the file."
        )
    return Pose(rotation, document.matrix_of(_PUPIL, 3, 1)[:, 0])


EXPORT = ExportFormat(
    name=NAME,
    terms=("geometry",),
    not_held=(
        "OpenCV's file holds the geometry: camera matrix, distortion, and under udccal's own names the pose. It cannot "
        "hold noise, wire, psf and backscatter.",
    ),
    encode=_encode,
    posed=True,
)
IMPORT = ImportFormat(NAME, _decode)
