"""True values of a simulated rig for the quantities that the fits estimate, under the names of the estimates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from udccal.models.geometry import Geometry
from udccal.sessions.schema import TermName
from udccal.simulation.truth import RigTruth


@dataclass(frozen=True)
class TrueValue:
    """A true quantity; ``name`` and unit are those of the term's estimate."""

    term: TermName
    name: str
    value: float


def true_values(truth: RigTruth) -> tuple[TrueValue, ...]:
    """Return every quantity that both a fit and the simulated rig have."""
    sensor, optics, panel = truth.sensor, truth.optics, truth.panel
    standoff_mm = -float(optics.pupil_mm[2])
    sigma_d = float(np.hypot(sensor.sigma_read_e, sensor.sigma_row_DN / sensor.K_DN_per_e))
    return (
        TrueValue("noise", "K_DN_per_e", sensor.K_DN_per_e),
        TrueValue("noise", "sigma_d_e", sigma_d),
        TrueValue("noise", "black_DN", sensor.black_DN),
        TrueValue("noise", "dark_current_e_per_s", sensor.dark_current_e_per_s),
        TrueValue("noise", "PRNU1288", sensor.PRNU1288),
        TrueValue("noise", "DSNU1288_e", sensor.DSNU1288_e),
        TrueValue("noise", "sigma_row_DN", sensor.sigma_row_DN),
        TrueValue("noise", "lambda_read", sensor.lambda_read),
        TrueValue("geometry", "fx", optics.fx_px),
        TrueValue("geometry", "fy", optics.fy_px),
        TrueValue("geometry", "cx", optics.cx_px),
        TrueValue("geometry", "cy", optics.cy_px),
        TrueValue("geometry", "tilt_deg", optics.tilt_deg),
        # An opening of some depth transmits light as a thin one at half its depth.
        TrueValue("wire", "standoff_per_pitch", (standoff_mm + panel.depth_mm / 2) / panel.pitch_mm),
        TrueValue("wire", "row_open", panel.row_open),
        TrueValue("wire", "column_open", panel.column_open),
        TrueValue("psf", "pitch_mm", panel.pitch_mm),
        TrueValue("psf", "row_open", panel.row_open),
        TrueValue("psf", "column_open", panel.column_open),
        TrueValue("psf", "depth_mm", panel.depth_mm),
        TrueValue("psf", "pupil_diameter_mm", optics.pupil_diameter_mm),
        TrueValue("backscatter", "gamma", panel.gamma),
        TrueValue("backscatter", "pupil_diameter_mm", optics.pupil_diameter_mm),
        TrueValue("backscatter", "standoff_mm", standoff_mm),
    )


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
