"""ROS's camera file, with the fields of ``camera_calibration_parsers`` (sensor_msgs/CameraInfo as YAML)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from udccal.errors import ProfileError
from udccal.profiles.exchange.format import ExportFormat, ImportFormat
from udccal.profiles.exchange.lens import Lens, lens_of, lens_with, pinhole_of
from udccal.profiles.exchange.plain_yaml import read_yaml
from udccal.profiles.profile import Profile

NAME = "ros-camera-info"
# ROS's names of OpenCV's model with five and with eight coefficients.
_PLUMB_BOB, _RATIONAL = "plumb_bob", "rational_polynomial"


def _encode(profile: Profile) -> bytes:
    lens = lens_of(profile)
    # The convention of a single camera: no rectifying rotation, and the projection of the rectified picture is K.
    projection = np.column_stack([lens.matrix, np.zeros(3)])
    return "".join(
        [
            f"image_width: {lens.columns}\nimage_height: {lens.rows}\ncamera_name: {_name(profile.rig.name)}\n",
            _matrix("camera_matrix", lens.matrix),
            f"distortion_model: {_PLUMB_BOB}\n",
            _matrix("distortion_coefficients", lens.distortion[None, :]),
            _matrix("rectification_matrix", np.eye(3)),
            _matrix("projection_matrix", projection),
        ]
    ).encode("ascii")


def _name(rig: str) -> str:
    """ROS takes letters, digits and underscores; a name of digits alone would be a number."""
    return "rig_" + "".join(letter if letter.isalnum() else "_" for letter in rig)


def _matrix(name: str, values: Float[np.ndarray, "rows columns"]) -> str:
    rows, columns = values.shape
    data = ", ".join(repr(float(value)) for value in values.ravel())
    return f"{name}:\n  rows: {rows}\n  cols: {columns}\n  data: [{data}]\n"


def _decode(text: str, where: str) -> Lens:
    document = read_yaml(text, where)
    model = document.word("distortion_model") if "distortion_model" in document.entries else _PLUMB_BOB
    if model not in (_PLUMB_BOB, _RATIONAL):
        raise ProfileError(
            f"Expected the distortion model {_PLUMB_BOB} or {_RATIONAL} in {where}, found '{model[:60]}'. Calibrate "
            f"with {_PLUMB_BOB}."
        )
    size = document.whole("image_width"), document.whole("image_height")
    pinhole = pinhole_of(where, document.matrix_of("camera_matrix", 3, 3))
    coefficients = document.matrix("distortion_coefficients").ravel()
    # Not used, but a file in which they cannot be right is not to be trusted.
    document.matrix_of("rectification_matrix", 3, 3)
    document.matrix_of("projection_matrix", 3, 4)
    return lens_with(where, size, pinhole, list(coefficients))


EXPORT = ExportFormat(
    name=NAME,
    terms=("geometry",),
    not_held=(
        "ROS's camera info holds the lens. It cannot hold the camera's pose behind the panel, noise, wire, psf and "
        "backscatter.",
    ),
    encode=_encode,
)
IMPORT = ImportFormat(NAME, _decode)
