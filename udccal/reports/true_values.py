"""True values of a simulated rig for the quantities that the fits estimate, under the names of the estimates."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from udccal.models.geometry import Geometry
from udccal.mounting import angles_deg
from udccal.sessions.schema import TermName
from udccal.simulation.emission import EMITTER_COLUMN_OFFSETS, EMITTER_ROW_OFFSET
from udccal.simulation.truth import RigTruth


@dataclass(frozen=True)
class TrueValue:
    """A true quantity; ``name`` and unit are those of the term's estimate, which is known up to whole ``period``s."""

    term: TermName
    name: str
    value: float
    period: float | None = None

    def error_of(self, estimate: float) -> float:
        """Return the estimate's error; the smallest, where whole periods do not count."""
        error = estimate - self.value
        return error if self.period is None else error - self.period * round(error / self.period)


def true_values(truth: RigTruth) -> tuple[TrueValue, ...]:
    """Return every quantity that both a fit and the simulated rig have.

    The backscatter's softness and its reflection's strength are the model's own: the simulator has sharp edges, and
    three planes whose light depends on the angle.
    """
    return (*_noise(truth), *_geometry(truth), *_wire(truth), *_psf(truth), *_backscatter(truth))


def _noise(truth: RigTruth) -> tuple[TrueValue, ...]:
    sensor = truth.sensor
    values = {
        "K_DN_per_e": sensor.K_DN_per_e,
        "black_DN": sensor.black_DN,
        "saturation_DN": min(sensor.black_DN + sensor.K_DN_per_e * sensor.full_well_e, 2.0**sensor.bits - 1),
        "sigma_d_e": float(np.hypot(sensor.sigma_read_e, sensor.sigma_row_DN / sensor.K_DN_per_e)),
        "lambda_read": sensor.lambda_read,
        "sigma_row_DN": sensor.sigma_row_DN,
        "q_DN": 1.0,
        "dark_current_e_per_s": sensor.dark_current_e_per_s,
        "DSNU1288_e": sensor.DSNU1288_e,
        "PRNU1288": sensor.PRNU1288,
    }
    return _of("noise", values)


def _geometry(truth: RigTruth) -> tuple[TrueValue, ...]:
    optics = truth.optics
    turn_deg = angles_deg(Rotation.from_matrix(optics.R_panel_camera).as_rotvec())
    lens = dict(zip(("k1", "k2", "p1", "p2", "k3"), optics.distortion, strict=True))
    frame = {"fx": optics.fx_px, "fy": optics.fy_px, "cx": optics.cx_px, "cy": optics.cy_px}
    angles = dict(zip(("tilt_deg", "roll_deg", "yaw_deg"), turn_deg, strict=True))
    turned = (TrueValue("geometry", name, float(value), 360.0) for name, value in angles.items())
    return (*_of("geometry", frame | lens), *turned)


def _wire(truth: RigTruth) -> tuple[TrueValue, ...]:
    optics, panel = truth.optics, truth.panel
    # An opening of some depth transmits light as a thin one at half its depth.
    standoff_mm = panel.depth_mm / 2 - float(optics.pupil_mm[2])
    # Rays converge from the pupil towards the focus.
    footprint_mm = optics.pupil_diameter_mm * (1 - standoff_mm / optics.focus_mm)
    values = {
        "rotation_x_deg": 0.0,
        "rotation_y_deg": 0.0,
        "rotation_z_deg": 0.0,
        "standoff_per_pitch": standoff_mm / panel.pitch_mm,
        "footprint_per_pitch": footprint_mm / panel.pitch_mm,
        "row_open": panel.row_open,
        "column_open": panel.column_open,
        "depth_per_pitch": panel.depth_mm / panel.pitch_mm,
    }
    offsets = (
        TrueValue("wire", f"offset_{axis}_periods", float(place) / panel.pitch_mm, 1.0)
        for axis, place in zip("xy", optics.pupil_mm[:2], strict=True)
    )
    return (*_of("wire", values), *offsets)


def _psf(truth: RigTruth) -> tuple[TrueValue, ...]:
    panel = truth.panel
    openings = {"row_open": panel.row_open, "column_open": panel.column_open}
    lengths = {"pitch_mm": panel.pitch_mm, "depth_mm": panel.depth_mm}
    # The simulator's rows are as deep as its columns.
    return _of("psf", openings | lengths | {"depth_ratio": 0.0, "pupil_diameter_mm": truth.optics.pupil_diameter_mm})


def _backscatter(truth: RigTruth) -> tuple[TrueValue, ...]:
    optics, panel, nominal = truth.optics, truth.panel, truth.description
    # Emitters from the centres of their pixels, as seen from the pupil's nominal place, in panel pixels.
    mounted = np.array([nominal.mounting.panel_x_px.value, nominal.mounting.panel_y_px.value])
    off_x, off_y = optics.pupil_mm[:2] / panel.pitch_mm - mounted
    red, green, blue = EMITTER_COLUMN_OFFSETS
    mix = panel.primaries / np.diag(panel.primaries)[:, None]
    values = {
        "gamma": panel.gamma,
        "standoff_mm": -float(optics.pupil_mm[2]),
        "pupil_diameter_mm": optics.pupil_diameter_mm,
        "reflection_mm": 2 * panel.glass_thickness_mm / panel.glass_index,
        "offset_x_px": green - off_x,
        "offset_y_px": EMITTER_ROW_OFFSET - off_y,
        "red_x_px": red - green,
        "red_y_px": 0.0,
        "blue_x_px": blue - green,
        "blue_y_px": 0.0,
    }
    colours = {
        f"mix_{to}{of}": mix[row, column]
        for row, to in enumerate("rgb")
        for column, of in enumerate("rgb")
        if row != column
    }
    return _of("backscatter", values | colours)


def _of(term: TermName, values: Mapping[str, float]) -> tuple[TrueValue, ...]:
    return tuple(TrueValue(term, name, float(value)) for name, value in values.items())


def true_geometry(truth: RigTruth) -> Geometry:
    """Return the geometry term that a perfect fit of the simulated rig ``truth`` would find."""
    optics = truth.optics
    return Geometry(
        focal_px=np.array([optics.fx_px, optics.fy_px]),
        principal_point_px=np.array([optics.cx_px, optics.cy_px]),
        distortion=np.array(optics.distortion),
        rotation_rad=np.asarray(Rotation.from_matrix(optics.R_panel_camera).as_rotvec(), dtype=np.float64),
        pupil_mm=np.array(optics.pupil_mm),
    )
