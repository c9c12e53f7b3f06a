"""Imports: the lens of another program's file becomes the geometry of a profile; nobody looked at the other terms."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from udccal.errors import ProfileError
from udccal.fitting.noise.fit import nominal_noise
from udccal.fitting.nominal import absent_backscatter, absent_psf, absent_wire, nominal_geometry
from udccal.models.geometry import Geometry
from udccal.profiles.exchange import mrcal, opencv_yaml, ros_camera_info
from udccal.profiles.exchange.format import ImportFormat
from udccal.profiles.exchange.lens import Lens
from udccal.profiles.exchange.usable import check_usable
from udccal.profiles.profile import Profile, build_profile
from udccal.profiles.provenance import as_text, provenance_now
from udccal.profiles.ranges import check_ranges
from udccal.result import FitResult, FitStatus
from udccal.rig import RigDescription

# mrcal's models hold their observations, some megabytes of them; the other formats are short.
MOST_BYTES = 8 * 1024 * 1024
IMPORTS: Mapping[str, ImportFormat] = {
    module.IMPORT.name: module.IMPORT for module in (opencv_yaml, ros_camera_info, mrcal)
}


def read_lens(path: Path, of: ImportFormat) -> Lens:
    """Read the lens in another program's file.

    Raises:
        ProfileError: when there is no such file, it is larger than 8 MiB, not text, or not of the format.
    """
    if not path.is_file():
        raise ProfileError(f"Expected a file at {path}, found none. Check the path.")
    with path.open("rb") as stream:
        content = stream.read(MOST_BYTES + 1)
    if len(content) > MOST_BYTES:
        raise ProfileError(f"Expected {path} to hold at most {MOST_BYTES} bytes, found more. It is no camera's file.")
    try:
        text = content.decode("utf-8-sig")  # some editors begin a text with a mark
    except UnicodeDecodeError as error:
        raise ProfileError(
            f"Expected {path} to be text, found other bytes. Check that it is the right file."
        ) from error
    return of.decode(text, str(path))


def profile_of(lens: Lens, rig: RigDescription, source: str) -> Profile:
    """Make a profile of a lens: its geometry, and the other terms as a session without captures leaves them.

    Args:
        lens: from ``read_lens``.
        rig: the rig with this camera; it gives what the lens does not, such as the nominal pose.
        source: where the lens comes from, for the notes.

    Raises:
        ProfileError: when the lens is of another size than the rig's sensor, a number is out of range, or no
            picture could be restored with the lens or its pose.
    """
    camera = rig.camera
    if (lens.columns, lens.rows) != (camera.columns, camera.rows):
        raise ProfileError(
            f"Expected a lens for the {camera.columns} x {camera.rows} px of the rig {rig.name}, found one for "
            f"{lens.columns} x {lens.rows} px. Name the rig with this camera."
        )
    geometry = _geometry(lens, nominal_geometry(rig))
    check_ranges(geometry, "geometry", f"Correct it in {source}.")
    check_usable(geometry, lens.pose is not None, rig, source)
    posed = "" if lens.pose is not None else " Its pose behind the panel is the rig description's nominal one."
    note = f"Imported from {as_text(source)}, which gives no error bars.{posed}"
    nobody = FitStatus.NOT_CAPTURED
    return build_profile(
        rig,
        provenance_now(None, None),
        noise=FitResult.failed("noise", nominal_noise(rig), nobody),
        geometry=FitResult.failed("geometry", geometry, FitStatus.IMPORTED, note),
        wire=FitResult.failed("wire", absent_wire(rig, geometry), nobody),
        psf=FitResult.failed("psf", absent_psf(rig, geometry), nobody),
        backscatter=FitResult.failed("backscatter", absent_backscatter(rig, geometry), nobody),
        wire_map=np.ones((camera.rows, camera.columns)),
    )


def _geometry(lens: Lens, nominal: Geometry) -> Geometry:
    rotation, pupil = nominal.rotation_rad, nominal.pupil_mm
    if lens.pose is not None:
        rotation = np.asarray(Rotation.from_matrix(lens.pose.R_panel_camera).as_rotvec())
        pupil = lens.pose.pupil_mm
    return Geometry(lens.focal_px, lens.principal_point_px, lens.distortion, rotation, pupil)
