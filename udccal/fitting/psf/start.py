"""What is known before the data: the rules, the panel as the rig and the wire have it, and the form of errors.

What a model leaves out matters the more, relatively, the fainter a sample is: its standard deviation is taken as the
model error times light^(3/4) peak^(1/4), e.g. at 10^-4 of the peak ten times the model error. The model error is that
of greatest likelihood of the residuals, and none where that is no better by BIC.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, final

import numpy as np
import scipy.optimize
from jaxtyping import Float

from udccal.fitting.engine.gaussian import Prior
from udccal.fitting.engine.orders import bic
from udccal.fitting.engine.robust import Huber
from udccal.fitting.psf.kernel import HEAD, pack
from udccal.models.diffraction import Diffraction
from udccal.models.geometry import Geometry
from udccal.models.wire import Wire
from udccal.rig import RigDescription

HUBER: Final = Huber()
WAVELENGTHS_NM: Final = np.linspace(400.0, 700.0, 13)


@final
@dataclass(frozen=True)
class PsfRules:
    """What the fit may spend, and its constants. More positions, shifts and samples are slower and more accurate.

    Attributes:
        positions, shifts: the most field positions, and pictures of each, in the fit of diffraction.
        least_positions: the fewest field positions that are fitted.
        half_px: largest window (rows, columns) to either side of the LED; the captured regions may bound it further.
        close_px: the same for the fit of diffraction, whose time grows with it.
        peak_half_px: all samples this close (rows, columns) to the LED go into the fit of diffraction.
        far_fraction: of the samples farther away, this fraction does.
        iterations: at most, of the fit of diffraction.
        first_model_error: of diffraction, before residuals give it; it also keeps a fit that is still far off from
            trusting the brightest samples alone.
        spectrum_bend, spectrum_sigma: prior standard deviations of the logarithm of a spectrum: of its bend from node
            to node, and about its start.
        blur_px, blur_log_sigma: prior of the blur beside pixel and disc: its value, and the sigma of its logarithm.
        wire_tolerance: part of the rig's tolerances that is left after the wire's fit.
        pitch_tolerance: part of the pitch's tolerance that the fit may use; see ``start_prior``.
        pitch_well_known: a pitch of larger relative tolerance takes more wavelengths to make up for it than daylight
            has.
        pitch_least_known: with a larger tolerance nothing is known of the pitch, and no fit is tried.
        footprint_periods: prior sigma of the footprint's place on the rows, after the wire's fit.
        picture_times: pictures whose mean squared residual is this many times the median picture's are outliers.
        residual_sizes: prior sizes of a residual beside diffraction, as fractions of the kernel nearby.
        highest_degree: of the residual's polynomials.
        reaches: parts of the window that may be enough for a residual, the narrowest first.
        worth: a higher order must lower the held-out loss of a sample by this (what is left of the samples then
            narrows by an eighth) to be worth its ten thousand coefficients: every restoration pays for them. Pictures
            held out have errors in common with the others: on a full-size rig of wave optics a residual gained 0.17,
            and made the kernel at new places a fifth worse.
        worth_of_room: the same for a wider residual, which costs less: no component more, only a larger one.
        doubtful: beyond this relative L2 error of diffraction alone, an image without diffraction is tried too.
        free_model_error: of such an image, before positions held out give it.
        own_sigma: prior standard deviations of a shot's place, in px, and relative light, beside such an image:
            centroids and sums of a crop's light are this good.
        error_knee, error_power: priors of the kernel error's knee and power; the knee's sigma is of its logarithm.
        poor: beyond this relative L2 error at positions held out the fit is poor.
    """

    positions: int = 10
    shifts: int = 3
    least_positions: int = 3
    half_px: tuple[int, int] = (48, 16)
    close_px: tuple[int, int] = (40, 14)
    peak_half_px: tuple[int, int] = (12, 6)
    far_fraction: float = 1 / 6
    iterations: int = 30
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
    own_sigma: tuple[float, float] = (0.05, 0.03)
    error_knee: tuple[float, float] = (0.3, 1.0)
    error_power: tuple[float, float] = (0.75, 0.15)
    poor: float = 0.2

    def close(self, half: tuple[int, int]) -> tuple[int, int]:
        """(rows, columns) to either side of the LED that diffraction is fitted to, of windows of this size."""
        return min(half[0], self.close_px[0]), min(half[1], self.close_px[1])


def start_model(rig: RigDescription, geometry: Geometry, wire: Wire, rules: PsfRules | None = None) -> Diffraction:
    """The rig's nominal panel and pupil, or the wire's where the wire shows; the spectra of common colour filters.

    Args:
        rig: the panel and the lens as described.
        geometry: has the pupil's place, in mm.
        wire: its numbers are in pitches of the panel.
        rules: the blur, and which pitches are well known.
    """
    panel, pitch, rules = rig.panel, rig.panel.pitch_mm.value, rules or PsfRules()
    nodes = wavelengths_nm(rig, rules)
    responses = np.exp(-0.5 * ((nodes - np.array([[600.0], [535.0], [460.0]])) / 45.0) ** 2) + 1e-3
    pupil = np.asarray(geometry.pupil, dtype=np.float64)
    if seen := wire_shows(wire):
        opened, offset = (wire.column_open, wire.row_open), wire.offset
        lengths = (wire.depth_per_pitch, wire.pupil_per_pitch, wire.standoff_per_pitch)
    else:
        opened, offset = (panel.column_open_fraction.value, panel.row_open_fraction.value), pupil[:2] / pitch
        lengths = (panel.structure_thickness_mm.value / pitch, rig.pupil_mm / pitch, -pupil[2] / pitch)
    return Diffraction(
        pitch_mm=np.float64(pitch),
        open_fraction=np.array([float(part) for part in opened]),
        thickness_mm=np.float64(float(lengths[0]) * pitch),
        pupil_mm=np.float64(float(lengths[1]) * pitch),
        blur_px=np.float64(rules.blur_px),
        offset=np.asarray(offset, dtype=np.float64),
        standoff_per_pitch=np.float64(float(lengths[2])),
        visibility=np.float64(seen),
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
    """Of the pitch, relatively: the psf measures all lengths in pitches."""
    return rig.panel.pitch_mm.tolerance / rig.panel.pitch_mm.value


def start_prior(rig: RigDescription, start: Diffraction, rules: PsfRules | None = None) -> Prior:
    """Tolerances of the rig on the panel's numbers, tighter where the wire has measured them; smooth spectra.

    Diffraction shows wavelength / pitch only. The pitch is therefore held where the rig has it, and the spectra are
    free to move: a pitch that is off by its tolerance then comes out as wavelengths that are.

    Args:
        rig: its tolerances are taken for standard deviations.
        start: the mean; its ``visibility`` says whether the wire has measured the panel's numbers.
        rules: how much tighter, and the sigmas of what the rig does not describe.
    """
    panel, theta, rules = rig.panel, pack(start), rules or PsfRules()
    tighter = rules.wire_tolerance if start.visibility else 1.0
    sigma = [
        rules.pitch_tolerance * min(panel.pitch_mm.tolerance, rules.pitch_well_known * panel.pitch_mm.value),
        tighter * panel.column_open_fraction.tolerance,
        tighter * panel.row_open_fraction.tolerance,
        tighter * panel.structure_thickness_mm.tolerance,
        tighter * 2.0 * rig.pupil_mm * rig.lens.f_number.tolerance / rig.lens.f_number.value,
        rules.blur_log_sigma,
        *(3 * (rules.footprint_periods,)),
    ]
    roots = [np.eye(HEAD, theta.size) / np.maximum(np.array(sigma), 1e-6)[:, None]]
    for pick in np.eye(theta.size)[HEAD:].reshape(3, -1, theta.size):
        roots += [np.diff(pick, 2, axis=0) / rules.spectrum_bend, pick / rules.spectrum_sigma]
    return Prior(theta.copy(), np.concatenate(roots))


def left_out(light: Float[np.ndarray, "*shots n"], model_error: float) -> Float[np.ndarray, "*shots n"]:
    """Standard deviation of what the model leaves out of samples that it expects to be this bright."""
    size = np.maximum(light, 0.0)
    return model_error * size**0.75 * size.max(axis=-1, keepdims=True) ** 0.25


def noise_at(
    level: Float[np.ndarray, "*n"],
    rate: Float[np.ndarray, "*n"],
    measured: Float[np.ndarray, "*n"],
    noise_per_rate: Float[np.ndarray, "*n"],
) -> Float[np.ndarray, "*n"]:
    """Variance of samples whose true rate is ``level``, if it was ``measured`` to be that of the ``rate`` found."""
    change = noise_per_rate * (np.maximum(level, 0.0) - np.maximum(rate, 0.0))
    # A sensor without read noise has no variance at all where no light is expected.
    return np.maximum(measured + change, 1e-2 * measured)


def estimate_model_error(
    residual: Float[np.ndarray, " samples"],
    variance: Float[np.ndarray, " samples"],
    unit: Float[np.ndarray, " samples"],
    parameters: int,
) -> float:
    """Model error of greatest likelihood; 0 where the noise alone explains the residuals as well, by BIC.

    ``unit`` is the standard deviation that a model error of 1 adds to a sample. The residuals of a fit of so many
    ``parameters`` are smaller than the errors; that is made up for. ``variance`` is of the sensor's noise.
    """
    raised = residual**2 * (residual.size / max(residual.size - parameters, 1))

    def loss(model_error: float) -> float:
        total = variance + (model_error * unit) ** 2
        return float(np.sum(np.log(total) + HUBER.loss(np.sqrt(raised / total))))

    bounds = (np.log(1e-4), np.log(0.5))
    found = scipy.optimize.minimize_scalar(lambda log: loss(float(np.exp(log))), bounds=bounds, method="bounded")
    return float(np.exp(found.x)) if bic(float(found.fun), 1.0, residual.size) < loss(0.0) else 0.0
