"""Where the diffraction fit starts, and what is known beforehand: the rig as built, and what the wire has measured."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from udccal.fitting.psf.blocks import HEAD, pack
from udccal.fitting.psf.descent import Prior
from udccal.models.diffraction import Diffraction
from udccal.models.geometry import Geometry
from udccal.models.wire import Wire
from udccal.rig import RigDescription

WAVELENGTHS_NM = np.linspace(400.0, 700.0, 13)
_PEAKS_NM, _WIDTH_NM = (600.0, 535.0, 460.0), 45.0
# Standard deviations of the logarithm of a spectrum: of its bend from node to node, and about its start.
_BEND, _FREEDOM = 1.0, 5.0
# Most of what blurs is known; the rest is taken for this, give or take a factor e.
_BLUR_PX, _BLUR_LOG = 0.1, 1.0
# Of the rig's tolerances: what is left of them after the wire's fit, and for a pitch that is held.
_MEASURED, _HELD = 0.3, 0.05
# A pitch whose relative tolerance is larger takes more wavelengths to make up for it than there are in daylight.
_WELL_KNOWN = 0.02
# With a larger one nothing is known of the pitch, and no fit is tried.
LEAST_KNOWN = 0.5
_PLACE_PERIODS = 0.05


def start_model(rig: RigDescription, geometry: Geometry, wire: Wire) -> Diffraction:
    """The rig's nominal panel and pupil, or what the wire says of them where the wire shows; common colour filters."""
    panel, pitch = rig.panel, rig.panel.pitch_mm.value
    seen = wire_shows(wire)
    nodes = wavelengths_nm(rig)
    responses = np.exp(-0.5 * ((nodes - np.array(_PEAKS_NM)[:, None]) / _WIDTH_NM) ** 2) + 1e-3
    nominal_open = np.array([panel.column_open_fraction.value, panel.row_open_fraction.value])
    measured_open = np.array([float(wire.column_open), float(wire.row_open)])
    pupil = np.asarray(geometry.pupil, dtype=np.float64)
    return Diffraction(
        pitch_mm=np.float64(pitch),
        open_fraction=measured_open if seen else nominal_open,
        thickness_mm=np.float64(float(wire.depth_per_pitch) * pitch if seen else panel.structure_thickness_mm.value),
        pupil_mm=np.float64(float(wire.pupil_per_pitch) * pitch if seen else rig.pupil_mm),
        blur_px=np.float64(_BLUR_PX),
        offset=np.asarray(wire.offset, dtype=np.float64) if seen else pupil[:2] / pitch,
        standoff_per_pitch=np.float64(float(wire.standoff_per_pitch) if seen else -pupil[2] / pitch),
        visibility=np.float64(1.0 if seen else 0.0),
        wavelengths_nm=nodes,
        spectrum=responses / responses.sum(axis=1, keepdims=True),
    )


def wire_shows(wire: Wire) -> bool:
    """Whether the wire fit saw the rows: only then is it known where the pupil's footprint lies on them."""
    return np.shape(wire.harmonics)[0] > 0


def wavelengths_nm(rig: RigDescription) -> Float[np.ndarray, " nodes"]:
    """Nodes of the spectra: daylight's, or what it looks like behind a panel whose pitch is off by its tolerance."""
    relative = min(pitch_tolerance(rig), LEAST_KNOWN)
    if relative <= _WELL_KNOWN:
        return WAVELENGTHS_NM
    first, last = WAVELENGTHS_NM[0] * (1 - relative), WAVELENGTHS_NM[-1] * (1 + relative)
    return np.linspace(first, last, round((last - first) / (WAVELENGTHS_NM[1] - WAVELENGTHS_NM[0])) + 1)


def pitch_tolerance(rig: RigDescription) -> float:
    """Of the pitch, relatively: all lengths that the psf tells are told in pitches."""
    return rig.panel.pitch_mm.tolerance / rig.panel.pitch_mm.value


def start_prior(rig: RigDescription, model: Diffraction, measured: bool) -> Prior:
    """Tolerances of the rig on the panel's numbers, tighter where the wire has measured them; smooth spectra.

    Diffraction shows wavelength / pitch only. The pitch is therefore held where the rig has it, and the spectra are
    free to move: a pitch that is off by its tolerance then comes out as wavelengths that are.
    """
    panel, theta = rig.panel, pack(model)
    tighter = _MEASURED if measured else 1.0
    sigma = [
        _HELD * min(panel.pitch_mm.tolerance, _WELL_KNOWN * panel.pitch_mm.value),
        tighter * panel.column_open_fraction.tolerance,
        tighter * panel.row_open_fraction.tolerance,
        tighter * panel.structure_thickness_mm.tolerance,
        tighter * 2.0 * rig.pupil_mm * rig.lens.f_number.tolerance / rig.lens.f_number.value,
        _BLUR_LOG,
        *(3 * (_PLACE_PERIODS,)),
    ]
    roots = [np.eye(HEAD, theta.size) / np.maximum(np.array(sigma), 1e-6)[:, None]]
    nodes = len(np.asarray(model.wavelengths_nm))
    for channel in range(3):
        pick = np.eye(theta.size)[HEAD + channel * nodes : HEAD + (channel + 1) * nodes]
        roots += [np.diff(pick, 2, axis=0) / _BEND, pick / _FREEDOM]
    return Prior(theta.copy(), np.concatenate(roots), np.asarray(model.wavelengths_nm))
