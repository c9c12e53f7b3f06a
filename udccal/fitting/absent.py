"""Terms that do nothing: a calibration uses them where a session has no steps for a term."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from udccal.fitting.nominal import nominal_backscatter
from udccal.fitting.wire.rules import ideal_wire, wire_start
from udccal.models.backscatter import Backscatter
from udccal.models.diffraction import Diffraction
from udccal.models.geometry import Geometry
from udccal.models.psf import PsfField
from udccal.models.wire import Wire
from udccal.rig import RigDescription


def absent_wire(rig: RigDescription, geometry: Geometry) -> Wire:
    """Return a wire map that is 1 everywhere: a panel that is open all over.

    Args:
        rig: gives the panel's numbers and the pitch.
        geometry: says where each pixel's ray meets the panel.
    """
    ideal = ideal_wire(geometry, wire_start(rig), np.zeros((0, 2)))
    return replace(ideal, row_open=np.float64(1.0), column_open=np.float64(1.0), depth_per_pitch=np.float64(0.0))


def absent_psf(rig: RigDescription, geometry: Geometry) -> PsfField:
    """Return a field whose kernel is a single pixel everywhere; its diffraction is nominal and has the fraction 0.

    Args:
        rig: gives the panel, the pupil, the stand-off, and the sensor's size.
        geometry: becomes part of the term.
    """
    panel, camera = rig.panel, rig.camera
    half = np.array([camera.columns - 1, camera.rows - 1]) / 2.0
    wavelengths_nm = np.linspace(400.0, 700.0, 4)
    return PsfField(
        geometry=geometry,
        diffraction=Diffraction(
            pitch_mm=np.float64(panel.pitch_mm.value),
            openings=np.array([panel.column_open.value, panel.row_open.value]),
            depth_mm=np.float64(panel.depth_mm.value),
            pupil_diameter_mm=np.float64(rig.pupil_diameter_mm),
            offset_periods=np.zeros(2),
            standoff_per_pitch=np.float64(rig.mounting.standoff_mm.value / panel.pitch_mm.value),
            visibility=np.float64(0.0),
            blur_px=np.float64(0.0),
            blur_growth=np.zeros(2),
            blur_colour=np.zeros(3),
            wavelengths_nm=wavelengths_nm,
            spectrum=np.full((3, len(wavelengths_nm)), 1.0 / len(wavelengths_nm)),
        ),
        diffraction_fraction=np.float64(0.0),
        residual=np.ones((1, 3, 1, 1)),
        centre_px=half,
        half_px=half,
        support_px=np.zeros(2),
        degree=0,
    )


def absent_backscatter(rig: RigDescription, geometry: Geometry) -> Backscatter:
    """Return a panel that sends no light back, with the rig's nominal dimensions.

    Args:
        rig: gives the dimensions and the sensor's size.
        geometry: becomes part of the term.
    """
    camera = rig.camera
    step = min(camera.columns, camera.rows) // 2
    mask = np.zeros((3, camera.rows // step, camera.columns // step))
    term = nominal_backscatter(geometry, rig, mask, step, window=1)
    nothing = np.float64(0.0)
    return replace(term, softness_px=np.float64(0.2), reflection=nothing, reflection_mm=nothing)
