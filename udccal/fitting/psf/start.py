"""What is known before the data: the rules of the fit, the panel as the rig and the wire have it, and how well."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, final

import numpy as np
from jaxtyping import Float

from udccal.fitting.engine.gaussian import Prior
from udccal.fitting.psf.kernel import HEAD, pack
from udccal.models.diffraction import Diffraction
from udccal.models.geometry import Geometry
from udccal.models.wire import Wire
from udccal.rig import RigDescription

WAVELENGTHS_NM: Final = np.linspace(400.0, 700.0, 13)
# Common colour filters.
_PEAKS_NM, _WIDTH_NM = (600.0, 535.0, 460.0), 45.0


@final
@dataclass(frozen=True)
class PsfRules:
    """What the fit may spend, and its constants. More positions, shifts and samples are slower and more accurate.

    Attributes:
        positions, shifts: so many field positions, and pictures of each, go into the fit of diffraction.
        half_px: largest window (rows, columns) to either side of the LED; the regions captured may bound it further.
        close_px: the same for the fit of diffraction, whose time grows with it.
        peak_half_px: all samples this close (rows, columns) to the LED go into the fit of diffraction.
        far_share: of the samples farther away, so many do.
        iterations: at most, of the fit of diffraction.
        rounds: descents at most, between which weights follow the model.
        first_model_error: of diffraction, until the residuals tell; it also keeps a fit that is still far off from
            trusting the brightest samples alone.
        spectrum_bend, spectrum_sigma: standard deviations of the logarithm of a spectrum: of its bend from node to
            node, and about its start.
        blur_px, blur_log_sigma: most of what blurs is known; the rest is taken for this, give or take a factor e.
        wire_tolerance: part of the rig's tolerances that is left after the wire's fit.
        pitch_tolerance: part of the pitch's tolerance that the fit may use; see ``start_prior``.
        pitch_well_known: a pitch whose relative tolerance is larger takes more wavelengths to make up for it than there
            are in daylight.
        pitch_least_known: with a larger tolerance nothing is known of the pitch, and no fit is tried.
        footprint_periods: how well the wire's fit knows where the footprint lies on the rows.
        picture_times: pictures whose mean squared residual is so many times the median picture's are outliers.
        residual_sizes: on top of diffraction a residual may be one of these fractions of the kernel nearby.
        highest_degree: of the residual's polynomials.
        reaches: parts of the window that may be enough for a residual, the narrowest first.
        worth: a higher order must lower the held-out loss of a sample by so much (what is left of the samples then
            narrows by an eighth) to be worth its ten thousand coefficients: every restoration pays for them. Pictures
            held out share what their makers did with the others: on a full-size rig of wave optics a residual gained
            0.17, and made the kernel at new places a fifth worse.
        worth_of_room: the same for a wider residual, which costs less: no component more, only a larger one.
        doubtful: beyond this relative L2 error of diffraction alone, an image without diffraction is tried too.
        free_model_error: of such an image, until positions that were held out tell.
        poor: beyond this relative L2 error at positions held out the fit is poor.
    """

    positions: int = 10
    shifts: int = 3
    half_px: tuple[int, int] = (48, 16)
    close_px: tuple[int, int] = (40, 14)
    peak_half_px: tuple[int, int] = (12, 6)
    far_share: float = 1 / 6
    iterations: int = 30
    rounds: int = 5
    first_model_error: float = 0.015
    spectrum_bend: float = 1.0
    spectrum_sigma: float = 5.0
    blur_px: float = 0.1
    blur_log_sigma: float = 1.0
    wire_tolerance: float = 0.3
    pitch_tolerance: float = 0.05
    pitch_well_known: float = 0.02
    pitch_least_known: float = 0.5
    footprint_periods: float = 0.05
    picture_times: float = 2.5
    residual_sizes: tuple[float, ...] = (0.1, 0.03, 0.01)
    highest_degree: int = 3
    reaches: tuple[float, ...] = (0.25, 0.5)
    worth: float = 0.25
    worth_of_room: float = 0.05
    doubtful: float = 0.05
    free_model_error: float = 0.01
    poor: float = 0.2

    def close(self, half: tuple[int, int]) -> tuple[int, int]:
        """(rows, columns) to either side of the LED that diffraction is fitted to, of windows of this size."""
        return min(half[0], self.close_px[0]), min(half[1], self.close_px[1])


def start_model(rig: RigDescription, geometry: Geometry, wire: Wire, rules: PsfRules | None = None) -> Diffraction:
    """The rig's nominal panel and pupil, or what the wire says of them where the wire shows; common colour filters."""
    panel, pitch, rules = rig.panel, rig.panel.pitch_mm.value, rules or PsfRules()
    seen = wire_shows(wire)
    nodes = wavelengths_nm(rig, rules)
    responses = np.exp(-0.5 * ((nodes - np.array(_PEAKS_NM)[:, None]) / _WIDTH_NM) ** 2) + 1e-3
    nominal_open = np.array([panel.column_open.value, panel.row_open.value])
    measured_open = np.array([float(wire.column_open), float(wire.row_open)])
    pupil = np.asarray(geometry.pupil_mm, dtype=np.float64)
    return Diffraction(
        pitch_mm=np.float64(pitch),
        openings=measured_open if seen else nominal_open,
        depth_mm=np.float64(float(wire.depth_per_pitch) * pitch if seen else panel.depth_mm.value),
        pupil_diameter_mm=np.float64(float(wire.footprint_per_pitch) * pitch if seen else rig.pupil_diameter_mm),
        blur_px=np.float64(rules.blur_px),
        offset_periods=np.asarray(wire.offset_periods, dtype=np.float64) if seen else pupil[:2] / pitch,
        standoff_per_pitch=np.float64(float(wire.standoff_per_pitch) if seen else -pupil[2] / pitch),
        visibility=np.float64(1.0 if seen else 0.0),
        wavelengths_nm=nodes,
        spectrum=responses / responses.sum(axis=1, keepdims=True),
    )


def wire_shows(wire: Wire) -> bool:
    """Whether the wire fit saw the rows: only then is it known where the pupil's footprint lies on them."""
    return np.shape(wire.harmonics)[0] > 0


def wavelengths_nm(rig: RigDescription, rules: PsfRules) -> Float[np.ndarray, " nodes"]:
    """Nodes of the spectra: daylight's, or what it looks like behind a panel whose pitch is off by its tolerance."""
    relative = min(pitch_tolerance(rig), rules.pitch_least_known)
    if relative <= rules.pitch_well_known:
        return WAVELENGTHS_NM
    first, last = WAVELENGTHS_NM[0] * (1 - relative), WAVELENGTHS_NM[-1] * (1 + relative)
    return np.linspace(first, last, round((last - first) / (WAVELENGTHS_NM[1] - WAVELENGTHS_NM[0])) + 1)


def pitch_tolerance(rig: RigDescription) -> float:
    """Of the pitch, relatively: all lengths that the psf tells are told in pitches."""
    return rig.panel.pitch_mm.tolerance / rig.panel.pitch_mm.value


def start_prior(rig: RigDescription, start: Diffraction, measured: bool, rules: PsfRules | None = None) -> Prior:
    """Tolerances of the rig on the panel's numbers, tighter where the wire has ``measured`` them; smooth spectra.

    Diffraction shows wavelength / pitch only. The pitch is therefore held where the rig has it, and the spectra are
    free to move: a pitch that is off by its tolerance then comes out as wavelengths that are.
    """
    panel, theta, rules = rig.panel, pack(start), rules or PsfRules()
    tighter = rules.wire_tolerance if measured else 1.0
    sigma = [
        rules.pitch_tolerance * min(panel.pitch_mm.tolerance, rules.pitch_well_known * panel.pitch_mm.value),
        tighter * panel.column_open.tolerance,
        tighter * panel.row_open.tolerance,
        tighter * panel.depth_mm.tolerance,
        tighter * 2.0 * rig.pupil_diameter_mm * rig.lens.f_number.tolerance / rig.lens.f_number.value,
        rules.blur_log_sigma,
        *(3 * (rules.footprint_periods,)),
    ]
    roots = [np.eye(HEAD, theta.size) / np.maximum(np.array(sigma), 1e-6)[:, None]]
    nodes = len(np.asarray(start.wavelengths_nm))
    for channel in range(3):
        pick = np.eye(theta.size)[HEAD + channel * nodes : HEAD + (channel + 1) * nodes]
        roots += [np.diff(pick, 2, axis=0) / rules.spectrum_bend, pick / rules.spectrum_sigma]
    return Prior(theta.copy(), np.concatenate(roots))
