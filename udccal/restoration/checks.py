"""What restoration accepts from outside: frames, exposures, panel pictures and raw files."""

from __future__ import annotations

from typing import Final

import numpy as np

from udccal.arguments import array_of, check_number, check_unmasked, found_instead
from udccal.errors import RestorationError, UdccalError
from udccal.models.noise import scalar
from udccal.profiles.profile import Profile
from udccal.rig import RigDescription

# From a nanosecond to a day.
EXPOSURES_S: Final = (1e-9, 86400.0)


def real_array(value: object, what: str) -> np.ndarray:
    """Return an array, or lists of numbers as one, in single precision at least: whole numbers would wrap around.

    Raises:
        RestorationError: when it does not hold real numbers, or some are masked; ``what`` names it.
    """
    check_unmasked(value, what, RestorationError)
    found = array_of(value)
    if found.dtype.kind not in "iuf":
        raise RestorationError(
            f"Expected {what} as an array of real numbers, found {found_instead(value)}. Convert it first."
        )
    return found.astype(np.result_type(found, np.float32), copy=False)


def check_exposure(exposure_s: object, error: type[UdccalError] = RestorationError) -> None:
    """Refuse what cannot be the exposure of a frame in s.

    Raises:
        UdccalError: of the kind ``error``, when it is no number from a nanosecond to a day.
    """
    advice = "Give that of the frame; 8 ms are 0.008 s."
    check_number(exposure_s, "a positive exposure in seconds", EXPOSURES_S, advice, error)


def check_frame(mosaic: object, exposure_s: object, rig: RigDescription) -> None:
    """Refuse a frame that the rig cannot have taken.

    Args:
        mosaic: the frame; accepted are 16-bit samples of the camera's size and range.
        exposure_s: exposure time; accepted is a number from a nanosecond to a day.
        rig: the rig description.

    Raises:
        RestorationError: when the type, size or range of the samples is another, some are masked, or the exposure
            cannot be one.
    """
    check_unmasked(mosaic, "a frame", RestorationError)
    camera = rig.camera
    if not isinstance(mosaic, np.ndarray) or mosaic.dtype != np.uint16 or mosaic.ndim != 2:
        raise RestorationError(
            f"Expected a mosaic of 16-bit samples, rows x columns of uint16, found {found_instead(mosaic)}. "
            "Give the raw frame; one of another byte order by .astype(np.uint16)."
        )
    if mosaic.shape != (camera.rows, camera.columns):
        raise RestorationError(
            f"Expected a frame of {camera.columns} x {camera.rows} samples as rig '{rig.name}' takes, found "
            f"{mosaic.shape[1]} x {mosaic.shape[0]}. Use the profile of the rig that took it, and whole frames."
        )
    if int(mosaic.max()) > rig.saturation_DN:
        raise RestorationError(
            f"Expected samples of {camera.bits} bits, at most {rig.saturation_DN}, found {int(mosaic.max())}. "
            "Give the frame as the camera delivered it, not scaled up."
        )
    check_exposure(exposure_s)


def check_panel_picture(picture: object, rig: RigDescription) -> None:
    """Refuse a panel picture that the rig's panel cannot have shown pixel for pixel; None is accepted.

    Raises:
        RestorationError: when it is not 8-bit RGB of the panel's size, or some of it is masked.
    """
    check_unmasked(picture, "a panel picture", RestorationError)
    expected = (rig.panel.rows, rig.panel.columns, 3)
    if picture is None:
        return
    if not isinstance(picture, np.ndarray) or picture.shape != expected or picture.dtype != np.uint8:
        raise RestorationError(
            f"Expected a panel picture of {expected[1]} x {expected[0]} 8-bit RGB pixels as the panel has, found "
            f"{found_instead(picture)}. Give what the panel showed, or leave it out."
        )


def check_raw_file(cfa: str, bits: int, black_DN: float, profile: Profile) -> None:
    """Refuse a raw file that states another camera than the profile's.

    Args:
        cfa: pattern of the file. bits: that hold its white level.
        black_DN: its black level; 0 where it states none.
        profile: the rig as measured. Its black level may be off by the rig's tolerance, or by rounding.

    Raises:
        RestorationError: when pattern, bits or black level are others.
    """
    camera, black = profile.rig.camera, scalar(profile.noise.term.black_DN)
    allowed = max(camera.black_DN.tolerance, 1.0)
    for what, found, expected, fits in (
        ("colour pattern", cfa, camera.cfa, cfa == camera.cfa),
        ("bits per sample", str(bits), str(camera.bits), bits == camera.bits),
        (
            "black level in DN",
            f"{black_DN:g}",
            f"{black:.4g} ± {allowed:g}",
            black_DN == 0 or abs(black_DN - black) <= allowed,
        ),
    ):
        if not fits:
            raise RestorationError(
                f"Expected a raw file with the {what} {expected} of rig '{profile.rig.name}', found {found}. Use the "
                "profile of the camera that took it, and the camera's own samples, neither turned nor cut."
            )
