"""Wire fit: from the average of flats to a smooth, noise-free map of the panel's modulation and the shading."""

from __future__ import annotations

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from udccal.fitting.result import Diagnostic, Estimate, FitResult, FitStatus
from udccal.fitting.wire_basis import Pixels, accumulate, residuals, sample_pixels
from udccal.fitting.wire_harmonics import WireStart, full_basis, plain_basis, possible_harmonics, wire_start
from udccal.fitting.wire_phase import (
    LEAST_GAIN,
    PhaseFit,
    add_increment,
    fit_phase,
    ideal_wire,
    reject_outliers,
    with_harmonics,
)
from udccal.fitting.wire_select import Selection, select
from udccal.models.geometry import Geometry, tilt_rad
from udccal.models.noise import Noise
from udccal.models.wire import Wire, modulation, panel_rotation, slopes, wire_map, wire_values
from udccal.numerics import in_float64
from udccal.sessions.store import Session

# Of the pixels that the fields are fitted to: so many for the search of the phase, and for its fit.
SEARCH_SHARE, PHASE_SHARE = 1 / 15, 1 / 6
PHASE_HARMONICS = 24
SHAPE_NAMES = (
    "rotation_x_deg",
    "rotation_y_deg",
    "rotation_z_deg",
    "standoff_per_pitch",
    "offset_x",
    "offset_y",
    "pupil_per_pitch",
    "row_open",
    "column_open",
    "depth_per_pitch",
)
SHAPE_UNITS = ("deg", "deg", "deg", "1", "period", "period", "1", "1", "1", "1")
# More samples than this gain little: the map's sigma is PRNU sqrt(parameters / samples).
FIELD_SAMPLES = 300_000
_LEAST_SAMPLES = 4000
_LEAST_SIGNAL_TO_NOISE = 3.0
_MOST_SATURATED = 0.01
# Structure that the model lacks, as strong as shot noise and PRNU together.
_WORST_CHI2 = 2.0
_MEAN_GRID = (192, 256)


def fit_wire(session: Session, noise: Noise, geometry: Geometry, field_samples: int = FIELD_SAMPLES) -> FitResult[Wire]:
    """Fit the wire term to the steps ``wire/dark`` and ``wire/flat`` of a session.

    Args:
        session: holds both averages at one exposure.
        noise: for saturation and PRNU.
        geometry: where the rays go.
        field_samples: pixels used for the fields; time grows with it, the map's sigma falls with its square root.

    Raises:
        SessionError: when a file of the session is missing or damaged.
    """
    flat = session.average(session.step("wire/flat").captures[0])
    dark = session.average(session.step("wire/dark").captures[0])
    clipped = float(np.mean(flat.mean >= 0.98 * float(np.asarray(noise.saturation_DN))))
    start = wire_start(session.rig)
    if clipped > _MOST_SATURATED:
        return _failed(geometry, start, FitStatus.SATURATED, f"{100 * clipped:.1f} % of the flat is clipped.")
    variance = flat.variance / flat.frames + dark.variance / dark.frames
    prnu = float(np.asarray(noise.PRNU1288))
    return fit_wire_map(flat.mean - dark.mean, variance, geometry, start, prnu, field_samples)


@in_float64
def fit_wire_map(
    signal: Float[np.ndarray, "rows columns"],
    variance: Float[np.ndarray, "rows columns"],
    geometry: Geometry,
    start: WireStart,
    prnu: float,
    field_samples: int = FIELD_SAMPLES,
) -> FitResult[Wire]:
    """Fit the wire to an averaged flat.

    Args:
        signal: flat minus dark, in any linear unit; colours need not be balanced.
        variance: of ``signal`` itself (after averaging), in its unit squared; PRNU not included.
        geometry: where the rays go.
        start: from the rig description.
        prnu: relative pixel-to-pixel response, added to the variance.
        field_samples: pixels used for the amplitude fields; the phase is fitted to a sixth of them.
    """
    values, relative_variance = _balanced(signal, variance, prnu)
    if values is None or float(np.median(values / np.sqrt(relative_variance))) < _LEAST_SIGNAL_TO_NOISE:
        return _failed(geometry, start, FitStatus.TOO_DARK, f"The flat's median is {float(np.median(signal)):.3g}.")
    if values.size < _LEAST_SAMPLES:
        return _failed(geometry, start, FitStatus.TOO_FEW_DATA, f"There are {values.size} pixels.")
    few, coarse, pixels = (
        sample_pixels(values, relative_variance, geometry, _odd_step(values.size, samples))
        for samples in (int(SEARCH_SHARE * field_samples), int(PHASE_SHARE * field_samples), field_samples)
    )
    harmonics, sizes = possible_harmonics(start)
    phase = fit_phase(geometry, start, few, coarse, harmonics, PHASE_HARMONICS)
    present = phase.gain_in_chi2 >= LEAST_GAIN
    drawn = int(np.count_nonzero(pixels.weight))
    pixels = reject_outliers(phase.wire, phase.gains, pixels)
    wire = with_harmonics(phase.wire, harmonics if present else harmonics[:0], pixels)
    basis = full_basis(sizes, phase.basis) if present else plain_basis()
    normal = accumulate(wire, phase.gains, pixels, basis)
    chosen = select(normal.matrix, normal.right, normal.power, normal.samples, basis.groups)
    wire, gains = add_increment(wire, phase.gains, basis, chosen.values)
    coarse = reject_outliers(wire, gains, coarse)
    residual = residuals(wire, gains, coarse)[coarse.weight > 0]
    wire = _mean_one(_trimmed(wire), values.shape)
    return _result(wire, residual, phase, chosen, pixels, drawn, present)


@in_float64
def sensor_map(wire: Wire, rows: int, columns: int) -> Float[np.ndarray, "rows columns"]:
    """The wire at every pixel of the sensor. It takes seconds: keep it."""
    return np.asarray(wire_map(wire, rows, columns), dtype=np.float64)


def _odd_step(pixels: int, samples: int) -> int:
    step = max(1, pixels // samples)
    return step + 1 - step % 2


def _balanced(
    signal: Float[np.ndarray, "rows columns"], variance: Float[np.ndarray, "rows columns"], prnu: float
) -> tuple[Float[np.ndarray, "rows columns"] | None, Float[np.ndarray, "rows columns"]]:
    """Each CFA site divided by its mean; the variance relative to that, PRNU added."""
    values, relative = signal.astype(np.float64), variance.astype(np.float64)
    for row in (0, 1):
        for column in (0, 1):
            mean = float(values[row::2, column::2].mean())
            if mean <= 0:
                return None, relative
            values[row::2, column::2] /= mean
            relative[row::2, column::2] /= mean**2
    return values, relative + (max(prnu, 1e-5) * np.maximum(values, 0.05)) ** 2


def _trimmed(wire: Wire) -> Wire:
    """Without the Legendre degrees that no harmonic uses: the map costs less to compute."""
    used = np.flatnonzero(np.any(np.asarray(wire.fields) != 0, axis=(0, 1, 2)))
    count = int(used.max()) + 1 if used.size else 1
    return eqx.tree_at(lambda w: w.fields, wire, np.asarray(wire.fields)[..., :count])


def _mean_one(wire: Wire, shape: tuple[int, ...]) -> Wire:
    """Scale the map to a mean of one over the sensor, by the midpoint rule on a regular grid."""
    down, across = ((np.arange(n) + 0.5) / n * size - 0.5 for n, size in zip(_MEAN_GRID, shape, strict=True))
    grid = np.stack(np.meshgrid(across, down), axis=-1).reshape(_MEAN_GRID[0] // 16, -1, 2)
    mean = float(np.mean([np.asarray(_values(wire, part, shape[0], shape[1])) for part in grid]))
    baseline = np.array(wire.baseline)
    baseline[0, 0] -= np.log(mean)
    return eqx.tree_at(lambda w: w.baseline, wire, baseline)


_values = jax.jit(wire_values, static_argnums=(2, 3))
_modulation = jax.jit(lambda wire, ideal, scaled: modulation(wire, slopes(wire, ideal), scaled))


def _result(
    wire: Wire,
    residual: Float[np.ndarray, " n"],
    phase: PhaseFit,
    chosen: Selection,
    pixels: Pixels,
    drawn: int,
    present: bool,
) -> FitResult[Wire]:
    used = int(np.count_nonzero(pixels.weight))
    spread = float(np.sqrt(np.mean(residual**2)))
    tilt = float(np.rad2deg(np.arcsin(np.asarray(panel_rotation(wire))[1, 2])))
    few = np.s_[:: max(1, len(pixels.ideal) // 16_384)]
    waves = np.asarray(_modulation(wire, pixels.ideal[few][:16_384], pixels.scaled[few][:16_384]))
    sigma = spread * float(np.sqrt(chosen.keep.sum() / max(used, 1) + len(phase.cov) / max(residual.size, 1)))
    status = FitStatus.CONVERGED if phase.converged else FitStatus.NOT_CONVERGED
    notes: tuple[str, ...] = ("cov covers the shape parameters; all coefficients show in wire_map_rms_sigma.",)
    if not present:
        status, notes = FitStatus.ABSENT, ("No modulation by rows is visible; the map is the shading alone.",)
    if chosen.variance > _WORST_CHI2:
        status = FitStatus.POOR_FIT
    estimates, cov = _estimates(wire, phase) if present else ((), np.zeros((0, 0)))
    return FitResult(
        term=wire,
        status=status,
        estimates=estimates,
        cov=cov,
        chi2_dof=chosen.variance,
        samples=used,
        candidates=chosen.candidates,
        diagnostics=(
            Diagnostic("wire_map_rms_sigma", 100 * sigma, "%"),
            Diagnostic("residual_rms", 100 * spread, "%"),
            Diagnostic("modulation_peak_to_peak", 100 * float(np.ptp(waves)), "%"),
            Diagnostic("harmonics", float(np.shape(wire.harmonics)[0]), "1"),
            Diagnostic("parameters", float(chosen.keep.sum()), "1"),
            Diagnostic("pixels_left_out", float(drawn - used), "1"),
            Diagnostic("gain_in_chi2", phase.gain_in_chi2, "1"),
            Diagnostic("tilt_by_wire", tilt, "deg"),
            Diagnostic("tilt_by_wire_minus_geometry", tilt - float(np.rad2deg(tilt_rad(wire.geometry))), "deg"),
            Diagnostic("iterations", float(phase.iterations), "1"),
        ),
        notes=notes,
    )


def _estimates(wire: Wire, phase: PhaseFit) -> tuple[tuple[Estimate, ...], Float[np.ndarray, "10 10"]]:
    # The fit's own parameters are radians and, for stand-off and pupil, logarithms.
    unit = np.ones(10)
    unit[:3] = 180 / np.pi
    unit[3], unit[6] = float(np.asarray(wire.standoff_per_pitch)), float(np.asarray(wire.pupil_per_pitch))
    cov = phase.cov * np.outer(unit, unit)
    shape = (wire.standoff_per_pitch, *np.mod(wire.offset, 1.0), wire.pupil_per_pitch)
    found = np.array([*np.rad2deg(wire.rotation), *shape, wire.row_open, wire.column_open, wire.depth_per_pitch])
    estimates = tuple(
        Estimate(name, float(value), float(np.sqrt(variance)), unit_name)
        for name, value, variance, unit_name in zip(SHAPE_NAMES, found, np.diag(cov), SHAPE_UNITS, strict=True)
    )
    return estimates, cov


def _failed(geometry: Geometry, start: WireStart, status: FitStatus, note: str) -> FitResult[Wire]:
    flat = ideal_wire(geometry, start, np.zeros((0, 2)))
    return FitResult(flat, status, (), np.zeros((0, 0)), 0.0, 0, notes=(note,))
