"""Noise fit: EMVA 1288's K, sigma_d, dark current, saturation, PRNU, DSNU; ELD's row noise and Tukey-lambda shape."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt16

from udccal.fitting import nonuniformity, photon_transfer, read_noise
from udccal.fitting.result import Diagnostic, Estimate, FitResult, FitStatus
from udccal.models.noise import Noise
from udccal.rig import RigDescription
from udccal.sessions.store import Session

_FEWEST_LEVELS = 3
# Below this many sigma_d of the dark noise the brightest flat holds no usable shot noise.
_LEAST_SIGNAL = 5.0
# Reduced chi-squared of the photon transfer line above which the sensor is not linear (or the lamp not steady).
_WORST_CHI2 = 6.0
UNITS = ("DN/e", "DN", "DN", "e", "1", "DN", "DN", "e/s", "e", "1")
NAMES = (
    "K_DN_per_e",
    "black_DN",
    "saturation_DN",
    "sigma_d_e",
    "lambda_read",
    "sigma_row_DN",
    "q_DN",
    "dark_current_e_per_s",
    "DSNU1288_e",
    "PRNU1288",
)


@dataclass(frozen=True)
class NoiseData:
    """All that the fit needs, already reduced frame by frame; built by ``reduce_dark``, ``reduce_flat``."""

    darks: tuple[read_noise.DarkPair, ...]
    rows: tuple[nonuniformity.RowMoments, ...]
    flats: tuple[photon_transfer.PairBins, ...]
    flat_stack: Float[np.ndarray, "rows columns"]
    dark_stack: Float[np.ndarray, "rows columns"]
    flat_frames: int
    dark_frames: int
    q_DN: int


def converter_step(frame: UInt16[np.ndarray, "rows columns"]) -> int:
    """Smallest step between codes: greater than 1 where a converter's bits are shifted up in 16-bit samples."""
    codes = np.flatnonzero(np.bincount(frame.ravel(), minlength=2))
    return int(np.gcd.reduce(np.diff(codes))) if codes.size > 2 else 1


def nominal_noise(rig: RigDescription) -> Noise:
    """Noise from the rig description alone: what a failed fit returns."""
    camera = rig.camera
    return Noise(
        K_DN_per_e=camera.K_DN_per_e.value,
        black_DN=camera.black_DN.value,
        saturation_DN=float(rig.saturation_DN),
        sigma_d_e=5.0,
        lambda_read=0.14,
        sigma_row_DN=0.0,
        q_DN=1.0,
        dark_current_e_per_s=0.0,
        DSNU1288_e=0.0,
        PRNU1288=0.0,
    )


def fit_noise(session: Session) -> FitResult[Noise]:
    """Fit the noise term to the steps ``noise/*`` of a session.

    Args:
        session: holds ``noise/dark_{i}`` and ``noise/flat_{i}`` (two frames each), ``noise/dark_stack`` and
            ``noise/flat_stack`` (averages).

    Raises:
        SessionError: when a file of the session is missing or damaged.
    """
    darks, rows, flats = [], [], []
    flat_stack = dark_stack = None
    q_DN = 1
    steps = {step.id: step for step in session.steps("noise")}
    flat_ids = [name for name in steps if name.startswith("noise/flat_") and name != "noise/flat_stack"]
    for name in flat_ids:
        first, second = (session.frame(capture) for capture in steps[name].captures[:2])
        flats.append(photon_transfer.bin_pair(first, second, steps[name].captures[0].exposure_s))
        if name == flat_ids[len(flat_ids) // 2]:
            q_DN = converter_step(first)
    for name, step in steps.items():
        if name == "noise/flat_stack":
            flat_stack = session.average(step.captures[0])
        elif name == "noise/dark_stack":
            dark_stack = session.average(step.captures[0])
        elif name.startswith("noise/dark_"):
            first, second = (session.frame(capture) for capture in step.captures[:2])
            darks.append(read_noise.dark_pair(first, second, step.captures[0].exposure_s, q_DN))
            rows.append(nonuniformity.row_moments(first, second))
    if flat_stack is None or dark_stack is None:
        return _failed(nominal_noise(session.rig), FitStatus.TOO_FEW_DATA, "There is no flat_stack or no dark_stack.")
    data = NoiseData(
        darks=tuple(darks),
        rows=tuple(rows),
        flats=tuple(flats),
        flat_stack=flat_stack.mean,
        dark_stack=dark_stack.mean,
        flat_frames=flat_stack.frames,
        dark_frames=dark_stack.frames,
        q_DN=q_DN,
    )
    return fit_noise_data(data, nominal_noise(session.rig))


def fit_noise_data(data: NoiseData, nominal: Noise) -> FitResult[Noise]:
    """Fit the noise term to reduced data; ``nominal`` is returned as the term where no fit is possible."""
    if len(data.darks) < 2 or len(data.flats) < _FEWEST_LEVELS:
        return _failed(
            nominal,
            FitStatus.TOO_FEW_DATA,
            f"Expected at least 2 dark and {_FEWEST_LEVELS} flat exposures, "
            f"found {len(data.darks)} and {len(data.flats)}.",
        )
    start = read_noise.start_values(data.darks)
    black, sigma = float(start[0]), float(start[2])
    brightest = max(float(np.median(flat.mean_DN)) for flat in data.flats) - black
    if brightest < _LEAST_SIGNAL * sigma:
        return _failed(nominal, FitStatus.TOO_DARK, f"The brightest flat lies {brightest:.3g} DN above black.")
    top = float(np.asarray(nominal.saturation_DN))
    saturation, sigma_saturation, saturated_bins = photon_transfer.find_saturation(data.flats, black, top)
    dark_variance = (sigma**2 + data.q_DN**2 / 12.0, 0.5 * sigma**2 + 0.02)
    line = photon_transfer.fit_transfer(data.flats, black, saturation, dark_variance)
    if line is None or line.levels < _FEWEST_LEVELS:
        found = 0 if line is None else line.levels
        return _failed(
            nominal,
            FitStatus.SATURATED,
            f"Expected at least {_FEWEST_LEVELS} flat exposures below 70 % of saturation, found {found}.",
        )
    if line.K_DN_per_e <= 0:
        return _failed(
            nominal,
            FitStatus.POOR_FIT,
            f"Expected the variance of flats to grow with their mean, found a slope of {line.K_DN_per_e:.3g} DN per "
            "electron: the two frames of a pair may be copies of each other.",
        )
    row_DN, _row_sigma = nonuniformity.combine_rows(data.rows)
    dark = read_noise.fit_dark(data.darks, read_noise.Surroundings(line.K_DN_per_e, row_DN))
    total = float(dark.values[2]) ** 2 + data.q_DN**2 / 12.0
    dark_variance = (total, max(2 * float(dark.values[2] * np.sqrt(dark.cov[2, 2])), 1e-3 * total))
    line = photon_transfer.fit_transfer(data.flats, float(dark.values[0]), saturation, dark_variance)
    assert line is not None  # the same bins as above
    stack_level = float(np.median(data.flat_stack))
    if stack_level > saturation - 4 * np.sqrt(line.K_DN_per_e * max(saturation - black, 1.0)):
        return _failed(nominal, FitStatus.SATURATED, f"The flat stack's median is {stack_level:.4g} DN.")
    return _assemble(data, dark, line, (saturation, sigma_saturation, saturated_bins))


def _assemble(
    data: NoiseData,
    dark: read_noise.DarkFit,
    line: photon_transfer.TransferFit,
    ceiling: tuple[float, float, int],
) -> FitResult[Noise]:
    K = line.K_DN_per_e
    black, per_s, sigma, spread, shape = (float(v) for v in dark.values)
    row_DN, row_sigma = nonuniformity.combine_rows(data.rows)
    edge_gain = max(dark.edge_gain, 0.2)
    signal = data.flat_stack.astype(np.float64) - data.dark_stack
    quiet = line.V0_DN2 * (1.0 / data.flat_frames + 1.0 / data.dark_frames)
    # The temporal variance comes from the photon transfer line: an average's own would hold the lamp's flicker.
    temporal = K * np.maximum(signal, 0.0) / data.flat_frames + quiet
    unevenness = nonuniformity.prnu(signal, temporal)
    values = np.array(
        [K, black, ceiling[0], sigma / K, shape, row_DN / edge_gain, data.q_DN, per_s / K, spread / K, unevenness.value]
    )
    # (K, black, per_s, sigma, spread, shape, row, PRNU, saturation) -> the ten estimates.
    variances = [line.cov[0, 0], row_sigma**2 / edge_gain**2, unevenness.sigma**2, ceiling[1] ** 2]
    inner = np.zeros((9, 9))
    inner[0, 0], inner[6, 6], inner[7, 7], inner[8, 8] = variances
    inner[1:6, 1:6] = dark.cov
    jacobian = np.zeros((10, 9))
    jacobian[[0, 1, 2, 4, 5, 9], [0, 1, 8, 5, 6, 7]] = 1.0
    for row, column in ((3, 3), (7, 2), (8, 4)):
        jacobian[row, column] = 1.0 / K
        jacobian[row, 0] = -values[row] / K
    cov = jacobian @ inner @ jacobian.T
    status = FitStatus.CONVERGED if dark.converged else FitStatus.NOT_CONVERGED
    if line.chi2_dof > _WORST_CHI2:
        status = FitStatus.POOR_FIT
    return FitResult(
        term=Noise(**{name: float(value) for name, value in zip(NAMES, values, strict=True)}),
        status=status,
        estimates=tuple(
            Estimate(name, float(value), float(np.sqrt(max(variance, 0.0))), unit)
            for name, value, variance, unit in zip(NAMES, values, np.diag(cov), UNITS, strict=True)
        ),
        cov=cov,
        chi2_dof=line.chi2_dof,
        samples=line.bins + sum(int(pair.counts.sum()) for pair in data.darks),
        diagnostics=(
            Diagnostic("photon_transfer_bins", float(line.bins), "1"),
            Diagnostic("photon_transfer_levels", float(line.levels), "1"),
            Diagnostic("V0_DN2", line.V0_DN2, "DN^2"),
            Diagnostic("saturated_bins", float(ceiling[2]), "1"),
            Diagnostic("hot_pixels", float(nonuniformity.count_hot(data.dark_stack)), "1"),
            Diagnostic("dark_samples_outside_histogram", float(sum(p.outside for p in data.darks)), "1"),
            Diagnostic("prnu_outliers_left_out", float(unevenness.outliers), "1"),
            Diagnostic("dark_fit_iterations", float(dark.iterations), "1"),
            Diagnostic("edge_gain", dark.edge_gain, "1"),
        ),
        notes=_notes(ceiling[2], ceiling[0]),
    )


def _notes(saturated_bins: int, saturation: float) -> tuple[str, ...]:
    if saturated_bins:
        return ()
    return (f"No flat reached saturation; the converter's largest code, {saturation:.0f} DN, is taken for it.",)


def _failed(nominal: Noise, status: FitStatus, note: str) -> FitResult[Noise]:
    return FitResult(
        term=nominal, status=status, estimates=(), cov=np.zeros((0, 0)), chi2_dof=0.0, samples=0, notes=(note,)
    )
