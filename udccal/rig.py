"""The rig as built, read from ``rig.toml``: nominal values with tolerances, from which fits start."""

from __future__ import annotations

import re
import reprlib
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator
from pydantic_core import ErrorDetails

from udccal.arguments import check_is_path
from udccal.errors import RigError
from udccal.io.reading import reading
from udccal.rig_folders import RIG_FILE, find_rig
from udccal.rig_versions import present_rig

CfaPattern = Literal["RGGB", "BGGR", "GRBG", "GBRG"]
_MAX_TOML_BYTES = 64 * 1024
RIG_NAME = r"^[a-z0-9][a-z0-9._-]{0,63}$"
# What pydantic's sentences begin with.
_SUBJECT = re.compile(r"^(Input|String)(?= should)")
# Further mistakes that one message names.
_MOST_MISTAKES = 20
# Of the psf in all; a full-size rig asks for 280.
_MOST_BRACKETS = 10_000
# 8K UHD and a little more.
_MOST_VIEW_PX = 2**25


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Nominal(_Strict):
    """A value the rig was built to have, and its tolerance in the same unit."""

    value: float
    tolerance: Annotated[float, Field(ge=0, le=1e6)]


def _within(low: float, high: float) -> AfterValidator:
    """Return a validator that bounds a nominal value."""

    def check(nominal: Nominal) -> Nominal:
        if not low <= nominal.value <= high:
            raise ValueError(f"a value of {nominal.value:g}, which must be from {low:g} to {high:g}")
        return nominal

    return AfterValidator(check)


class Panel(_Strict):
    """The transparent display."""

    model: str
    columns: Annotated[int, Field(ge=8, le=16384)]
    rows: Annotated[int, Field(ge=8, le=16384)]
    pitch_mm: Annotated[Nominal, _within(0.001, 100.0)]
    row_open: Annotated[Nominal, _within(0.001, 1.0)]
    column_open: Annotated[Nominal, _within(0.001, 1.0)]
    depth_mm: Annotated[Nominal, _within(0.0, 100.0)]
    glass_thickness_mm: Annotated[float, Field(gt=0, le=20)]
    glass_index: Annotated[float, Field(ge=1, le=2.5)]
    gamma: Annotated[Nominal, _within(0.1, 10.0)]


class Camera(_Strict):
    """The sensor."""

    model: str
    columns: Annotated[int, Field(ge=64, le=16384)]
    rows: Annotated[int, Field(ge=64, le=16384)]
    pitch_um: Annotated[float, Field(ge=0.1, le=100)]
    cfa: CfaPattern
    bits: Annotated[int, Field(ge=8, le=16)]
    full_well_e: Annotated[Nominal, _within(1.0, 1e9)]
    black_DN: Annotated[Nominal, _within(-65536.0, 65536.0)]
    K_DN_per_e: Annotated[Nominal, _within(1e-4, 1e5)]
    frame_rate_hz: Annotated[float, Field(gt=0, le=1e6)]
    min_exposure_s: Annotated[float, Field(gt=0, le=1e6)]
    max_exposure_s: Annotated[float, Field(gt=0, le=1e6)]

    @model_validator(mode="after")
    def _exposures_in_order(self) -> Camera:
        if self.min_exposure_s > self.max_exposure_s:
            raise ValueError(f"a shortest exposure of {self.min_exposure_s:g} s, longer than the longest")
        return self


class Lens(_Strict):
    """The lens; its entrance pupil has the diameter ``focal_mm / f_number``."""

    model: str
    focal_mm: Annotated[Nominal, _within(0.01, 1e5)]
    f_number: Annotated[Nominal, _within(0.1, 1000.0)]
    focus_mm: Annotated[float, Field(gt=0, le=1e9)]


class Mounting(_Strict):
    """Where the entrance pupil sits behind the panel, and where the camera points.

    ``T_panel_camera`` has the rotation Ry(yaw) Rx(-tilt) Rz(roll); tilt is positive when the camera looks down.
    ``panel_x_px``, ``panel_y_px`` is the panel pixel straight in front of the pupil.
    """

    standoff_mm: Annotated[Nominal, _within(0.01, 1e5)]
    tilt_deg: Annotated[Nominal, _within(-180.0, 180.0)]
    roll_deg: Annotated[Nominal, _within(-360.0, 360.0)]
    yaw_deg: Annotated[Nominal, _within(-180.0, 180.0)]
    panel_x_px: Annotated[Nominal, _within(-1e6, 1e6)]
    panel_y_px: Annotated[Nominal, _within(-1e6, 1e6)]


class Captures(_Strict):
    """Numbers of captures in a full calibration; each trades time for accuracy."""

    flats: Annotated[int, Field(ge=2, le=10000)] = 300
    noise_levels: Annotated[int, Field(ge=4, le=1000)] = 20
    noise_stack: Annotated[int, Field(ge=2, le=1000)] = 16
    psf_columns: Annotated[int, Field(ge=1, le=100)] = 7
    psf_rows: Annotated[int, Field(ge=1, le=100)] = 5
    psf_shifts: Annotated[int, Field(ge=1, le=100)] = 8
    psf_exposures: Annotated[int, Field(ge=1, le=30)] = 7
    psf_region_columns: Annotated[int, Field(ge=16, le=16384)] = 256
    psf_region_rows: Annotated[int, Field(ge=16, le=16384)] = 512
    psf_led_mm: Annotated[float, Field(gt=0, le=1000)] = 1.15
    psf_distance_mm: Annotated[float, Field(gt=0, le=1e6)] = 2000.0
    backscatter_pictures: Annotated[int, Field(ge=2, le=1000)] = 24
    backscatter_frames: Annotated[int, Field(ge=2, le=10000)] = 8
    board_views: Annotated[int, Field(ge=3, le=1000)] = 20

    @model_validator(mode="after")
    def _can_be_captured(self) -> Captures:
        brackets = self.psf_columns * self.psf_rows * self.psf_shifts
        if brackets > _MOST_BRACKETS:
            raise ValueError(f"{brackets} places of the LED with their shifts, which must be at most {_MOST_BRACKETS}")
        return self


class View(_Strict):
    """The picture that restoration delivers."""

    columns: Annotated[int, Field(ge=16, le=16384)] = 1920
    rows: Annotated[int, Field(ge=16, le=16384)] = 1080

    @model_validator(mode="after")
    def _holds_no_more_than_8k(self) -> View:
        if self.columns * self.rows > _MOST_VIEW_PX:
            raise ValueError(f"{self.columns} x {self.rows} pixels, which must be at most {_MOST_VIEW_PX} in all")
        return self


class RigDescription(_Strict):
    """One rig as it was built to be. Older versions are read too, from files, sessions and profiles."""

    format: Literal["udccal-rig"]
    version: Literal[2]
    name: Annotated[str, Field(pattern=RIG_NAME)]
    panel: Panel
    camera: Camera
    lens: Lens
    mounting: Mounting
    captures: Captures
    view: View

    @model_validator(mode="before")
    @classmethod
    def _of_present_version(cls, found: Any) -> Any:
        return present_rig(found)

    @property
    def focal_px(self) -> float:
        """Nominal focal length in sensor pixels."""
        return self.lens.focal_mm.value * 1000.0 / self.camera.pitch_um

    @property
    def pupil_diameter_mm(self) -> float:
        """Nominal entrance-pupil diameter."""
        return self.lens.focal_mm.value / self.lens.f_number.value

    @property
    def saturation_DN(self) -> int:
        """Largest number that the converter can deliver."""
        return int(2**self.camera.bits - 1)

    @property
    def lowest_saturation_DN(self) -> float:
        """Lowest level at which a sample may clip within the tolerances: the converter's end, or the full well."""
        camera = self.camera
        K, well = (nominal.value - nominal.tolerance for nominal in (camera.K_DN_per_e, camera.full_well_e))
        return min(float(self.saturation_DN), camera.black_DN.value - camera.black_DN.tolerance + K * well)


def load_rig(name_or_path: str | Path) -> RigDescription:
    """Read and check a rig description.

    Args:
        name_or_path: name of a rig that ships with udccal, or of one of your own (in ``~/.local/share/udccal/rigs`` or
            ``$UDCCAL_RIGS``), or the path of a folder with a ``rig.toml``.

    Raises:
        RigError: when there is no such rig, the file is not TOML, or a value is missing, unknown or out of range.
    """
    check_is_path(name_or_path, "a rig", RigError)
    file = find_rig(name_or_path) / RIG_FILE
    with reading(file, RigError):
        raw = file.read_bytes()
    if len(raw) > _MAX_TOML_BYTES:
        raise RigError(f"Expected {file} to hold at most {_MAX_TOML_BYTES} bytes, found {len(raw)}. Shorten it.")
    try:
        return RigDescription.model_validate(tomllib.loads(raw.decode("utf-8-sig")))
    except RecursionError as error:
        raise RigError(f"Expected {file} to be a rig, found lists inside lists without end. Correct it.") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise RigError(f"Expected {file} to be TOML, found: {error}. Correct that line.") from error
    except ValidationError as error:
        first, *others = error.errors()
        more = f", and {', '.join(_place(other['loc']) for other in others[:_MOST_MISTAKES])}" if others else ""
        raise RigError(
            f"Expected a valid '{_place(first['loc'])}' in {file}, found {_found(first)}. Correct that value{more}."
        ) from error


def _found(mistake: ErrorDetails) -> str:
    """Say what stands where a valid value belongs, and what a valid one is."""
    given = reprlib.repr(mistake["input"])
    match mistake["type"]:
        case "missing":
            return "none"
        case "extra_forbidden":
            return "a name that a rig does not have"
        case "value_error":
            return str(mistake["ctx"]["error"])
        case "model_type" if mistake["ctx"]["class_name"] == Nominal.__name__:
            return f"{given} without a tolerance, where {{ value = {given}, tolerance = ... }} belongs"
        case "model_type":
            return f"{given}, where a section belongs"
        case _:
            return f"{given}: {_SUBJECT.sub('it', mistake['msg'])}"


def _place(location: tuple[int | str, ...]) -> str:
    return ".".join(str(part) for part in location)
