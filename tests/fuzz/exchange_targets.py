"""Readers of what comes from elsewhere: other programs' lenses, and a profile's zip file."""

from __future__ import annotations

import functools
import tempfile
import zipfile
from pathlib import Path

import numpy as np

from tests.fuzz.target import Target, of_file, written
from udccal.profiles.archive import unpack_archive
from udccal.profiles.exchange.imports import IMPORTS, profile_of, read_lens
from udccal.rig import RigDescription, load_rig

_MATRIX = "  rows: 3\n  cols: {}\n  data: [{}]\n"
_PINHOLE = "880.5, 0., 506., 0., 880.25, 379.5, 0., 0., 1."
_ROS = (
    "image_width: 1024\nimage_height: 768\ncamera_name: a\ncamera_matrix:\n"
    + _MATRIX.format(3, _PINHOLE)
    + "distortion_model: plumb_bob\ndistortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [-.06, 2e-2, 0., 0, 1.]\n"
    + "rectification_matrix:\n"
    + _MATRIX.format(3, "1, 0, 0, 0, 1, 0, 0,\n   0, 1")
    + "projection_matrix:\n"
    + _MATRIX.format(4, "880., 0., 506., 0., 0., 880., 379., 0., 0., 0., 1., 0.")
)
_OPENCV = (
    "%YAML:1.0\n---\nimage_width: 1024\nimage_height: 768\ncalibration_time: \"at # noon\"\n"
    "camera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [ " + _PINHOLE + " ]\n"
    "distortion_coefficients: !!opencv-matrix\n   rows: 5\n   cols: 1\n   dt: d\n   data: [ -.06, 2e-2, 0., 0., 1. ]\n"
    "R_panel_camera: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [ 1, 0, 0, 0, 1, 0, 0, 0, 1 ]\n"
    "pupil_mm: !!opencv-matrix\n   rows: 3\n   cols: 1\n   dt: d\n   data: [ 604.8, 189., -14. ]\n"
)  # fmt: skip
_MRCAL = (
    "{\n    'lensmodel':  'LENSMODEL_OPENCV8',\n\n    # fx,fy,cx,cy,...\n    'intrinsics': [ 880.5, 880, 506, 379.5, "
    "-0.06, 0.02, -3e-4, 1e-05, -0.004, 0, 0, 0,],\n    'extrinsics': [ 0.3, 0, 0, 1, 2, 3,],\n"
    "    'imagersize': [ 1024, 768,],\n    'optimization_inputs': b'P)h>@6aWAK',\n}\n"
)


@functools.cache
def _rig() -> RigDescription:
    return load_rig("lg55-reduced")


def _lens(name: str, *texts: str) -> Target:
    def read(path: Path) -> None:
        made = profile_of(read_lens(path, IMPORTS[name]), _rig(), "f")
        assert np.isfinite(made.geometry.term.focal_px).all()

    return Target(name, of_file("f", read), lambda: tuple(text.encode() for text in texts), 4096)


def _zip() -> bytes:
    def write(path: Path) -> None:
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("profile.json", b'{"format": "udccal-profile"}' * 3, zipfile.ZIP_DEFLATED)
            archive.writestr("wire_map.exr", b"v/1\x01")

    return written("p.zip", write)


def _unpack(path: Path) -> None:
    """Whatever the file says, nothing is written but plain files in the folder."""
    with tempfile.TemporaryDirectory(prefix="udccal-fuzz-") as around:
        folder = Path(around) / "in" / "folder"
        folder.mkdir(parents=True)
        try:
            unpack_archive(path, folder)
        finally:
            outside = [item for item in Path(around).rglob("*") if item not in (folder, folder.parent)]
            assert all(item.parent == folder and item.is_file() and not item.is_symlink() for item in outside), outside


EXCHANGE_TARGETS = (
    _lens("ros-camera-info", _ROS, _ROS.replace("[-.06, .02, 0., 0, 1.]", "\n  - -.06\n  - 2e-2\n  - 0\n  - 0\n  - 0")),
    _lens("opencv-yaml", _OPENCV),
    _lens("mrcal", _MRCAL, _MRCAL.replace("LENSMODEL_OPENCV8", "LENSMODEL_OPENCV5").replace(", 0, 0, 0,]", "]")),
    Target("packed-profile", of_file("p.zip", _unpack), lambda: (_zip(),), 2048),
)
