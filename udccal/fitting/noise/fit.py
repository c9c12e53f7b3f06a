"""Noise fit: EMVA 1288's K, sigma_d, dark current, saturation, PRNU, DSNU; ELD's row noise and Tukey-lambda shape."""

from __future__ import annotations

import numpy as np
from jaxtyping import UInt16

from udccal.fitting.noise.codes import DarkPair, dark_pair
from udccal.fitting.noise.curve import Curve, fit_curve, rough_gain
from udccal.fitting.noise.dark import DarkFrames, DarkTerms, fit_dark_terms
from udccal.fitting.noise.data import NoiseData
from udccal.fitting.noise.light import LightTerms, fit_light_terms
from udccal.fitting.noise.moments import PairMoments, RowMoments, StackMoments
from udccal.fitting.noise.pairs import reduce_pair
from udccal.fitting.noise.read_noise import start_values
from udccal.fitting.noise.report import NAMES, UNITS, assemble, assumed_noise, failed
from udccal.models.noise import Noise
from udccal.result import FitResult, FitStatus
from udccal.rig import RigDescription
from udccal.sessions.schema import StoredStep
from udccal.sessions.store import Session

__all__ = ["NAMES", "UNITS", "NoiseData", "converter_step", "fit_noise", "fit_noise_data", "nominal_noise"]

_FEWEST_LEVELS = 3
# The dark fit wants the gain, the gain the dark fit: so often at most.
_MOST_ROUNDS = 5
# A gain known worse than to a tenth is no gain: what is divided by it has no symmetric error.
_LEAST_GAIN_SIGMA = 10.0
# Offsets so many times the temporal noise leave nothing of a cut-off distribution to look at.
_MOST_OFFSET = 30.0
# Reduced chi-squared of the photon transfer line above which the sensor is not what the model says.
_WORST_CHI2 = 6.0


def converter_step(frame: UInt16[np.ndarray, "rows columns"]) -> int:
    """Smallest step between codes: greater than 1 where a converter's bits are shifted up in 16-bit samples."""
    codes = np.flatnonzero(np.bincount(frame.ravel(), minlength=2))
    return int(np.gcd.reduce(np.diff(codes))) if codes.size > 2 else 1


def nominal_noise(rig: RigDescription) -> Noise:
    """Noise from the rig description alone: what a failed fit returns."""
    camera = rig.camera
    return assumed_noise(camera.K_DN_per_e.value, camera.black_DN.value, float(rig.saturation_DN))


def fit_noise(session: Session) -> FitResult[Noise]:
    """Fit the noise term to the steps ``noise/*`` of a session.

    Args:
        session: holds ``noise/dark_{i}`` and ``noise/flat_{i}`` (two frames each), ``noise/dark_stack`` and
            ``noise/flat_stack`` (averages).

    Raises:
        SessionError: when a file of the session is missing or damaged.
    """
    nominal = nominal_noise(session.rig)
    steps = {step.id: step for step in session.steps("noise")}
    stacks = [_stack(session, steps.get(f"noise/{kind}_stack")) for kind in ("dark", "flat")]
    dark_stack, flat_stack = stacks
    if flat_stack is None or dark_stack is None:
        return failed(nominal, FitStatus.TOO_FEW_DATA, "There is no flat_stack or no dark_stack.")
    flat_ids = [name for name in steps if name.startswith("noise/flat_") and name != "noise/flat_stack"]
    dark_ids = [name for name in steps if name.startswith("noise/dark_") and name != "noise/dark_stack"]
    q_DN = 1
    if flat_ids:
        q_DN = converter_step(session.frame(steps[flat_ids[len(flat_ids) // 2]].captures[0]))
    top = int(session.rig.saturation_DN)
    darks = [_dark(session, steps[name], q_DN, top) for name in dark_ids]
    data = NoiseData(
        darks=tuple(pair for pair, _ in darks),
        dark_rows=tuple(rows for _, rows in darks),
        flats=tuple(_flat(session, steps[name]) for name in flat_ids),
        flat_stack=flat_stack,
        dark_stack=dark_stack,
        q_DN=q_DN,
        top_DN=float(top),
    )
    return fit_noise_data(data, nominal)


def _stack(session: Session, step: StoredStep | None) -> StackMoments | None:
    if step is None:
        return None
    average = session.average(step.captures[0])
    return StackMoments(step.captures[0].exposure_s, average.mean, average.frames)


def _flat(session: Session, step: StoredStep) -> PairMoments:
    first, second = (session.frame(capture) for capture in step.captures[:2])
    return reduce_pair(first, second, step.captures[0].exposure_s)


def _dark(session: Session, step: StoredStep, q_DN: int, top: int) -> tuple[DarkPair, RowMoments]:
    first, second = (session.frame(capture) for capture in step.captures[:2])
    exposure_s = step.captures[0].exposure_s
    return dark_pair(first, second, exposure_s, q_DN, top), reduce_pair(first, second, exposure_s).rows


def fit_noise_data(data: NoiseData, nominal: Noise) -> FitResult[Noise]:
    """Fit the noise term to reduced data; ``nominal`` is returned as the term where no fit is possible."""
    if len(data.darks) < 2 or len(data.flats) < _FEWEST_LEVELS:
        return failed(
            nominal,
            FitStatus.TOO_FEW_DATA,
            f"Expected at least 2 dark and {_FEWEST_LEVELS} flat exposures, "
            f"found {len(data.darks)} and {len(data.flats)}.",
        )
    if any(not np.isfinite(pair.counts.sum()) or pair.counts.sum() < 100 for pair in data.darks):
        return failed(nominal, FitStatus.TOO_FEW_DATA, "A dark pair holds fewer than 100 samples of like codes.")
    refused = _look(data, nominal)
    if refused is not None:
        return refused
    frames = DarkFrames(data.darks, data.dark_rows, data.dark_stack, data.q_DN)
    dark = fit_dark_terms(frames, rough_gain(data))
    curve = fit_curve(data, dark)
    for _ in range(_MOST_ROUNDS):
        if curve.usable_levels < _FEWEST_LEVELS or curve.K_DN_per_e <= 0 or not _gain_matters(dark, curve, frames):
            break
        dark = fit_dark_terms(frames, curve.K_DN_per_e, dark)
        curve = fit_curve(data, dark)
    return _judged(data, dark, fit_light_terms(data, dark, curve), nominal)


def _look(data: NoiseData, nominal: Noise) -> FitResult[Noise] | None:
    """What can be refused at sight."""
    start = start_values(data.darks)
    brightest = max(float(np.median(flat.mean_DN)) for flat in data.flats) - float(start[0])
    if brightest < 0.05 * float(np.sqrt(start[2])):
        return failed(nominal, FitStatus.TOO_DARK, f"The brightest flat lies {brightest:.3g} DN above black.")
    if any(pair.edges_DN[-1] == np.inf and pair.counts[-1].sum() > 0.5 * pair.counts.sum() for pair in data.darks):
        note = "Dark frames lie at the converter's largest code. Lower the black level."
        return failed(nominal, FitStatus.SATURATED, note)
    return None


def _gain_matters(dark: DarkTerms, curve: Curve, frames: DarkFrames) -> bool:
    """Whether another gain moves the dark current's shot noise by half of what the read noise is known to.

    To first order the photon transfer fit moves the read noise with the gain by itself.
    """
    longest = max(pair.exposure_s for pair in frames.pairs)
    moved = abs(curve.K_DN_per_e - dark.K_DN_per_e) * dark.dark_DN_per_s.value * longest
    return moved > 0.5 * float(np.sqrt(dark.read_DN2.variance))


def _hides_black(data: NoiseData, dark: DarkTerms) -> bool:
    """Codes cut off at 0, and offsets of pixels far larger than their noise: no code tells where black is."""
    cut = any(pair.edges_DN[0] == -np.inf and pair.counts[0].sum() > 0.01 * pair.counts.sum() for pair in data.darks)
    quiet = dark.read_DN2.value + dark.row_DN2.value
    return not dark.white and cut and dark.dsnu_DN2.value > _MOST_OFFSET**2 * max(quiet, 1e-9)


def _judged(data: NoiseData, dark: DarkTerms, light: LightTerms, nominal: Noise) -> FitResult[Noise]:
    curve = light.curve
    if _hides_black(data, dark):
        note = "Dark codes are cut off at 0 and show too little noise to tell black. Raise the black level."
        return failed(nominal, FitStatus.POOR_FIT, note)
    if light.copies:
        return failed(
            nominal,
            FitStatus.POOR_FIT,
            f"Expected the variance of flats to grow with their mean, found a slope of {curve.K_DN_per_e:.3g} DN per "
            "electron: the two frames of a pair may be copies of each other.",
        )
    if curve.usable_levels < _FEWEST_LEVELS:
        status = FitStatus.SATURATED if light.saturation.bins else FitStatus.TOO_DARK
        return failed(
            nominal,
            status,
            f"Expected at least {_FEWEST_LEVELS} flat exposures between the dark noise and 90 % of saturation, "
            f"found {curve.usable_levels}.",
        )
    sigma_K = float(np.sqrt(light.transfer.cov[0, 0]))
    if (
        not np.isfinite(sigma_K)
        or sigma_K <= 0
        or abs(curve.K_DN_per_e) < _LEAST_GAIN_SIGMA * sigma_K
        or (curve.shot_significance < _LEAST_GAIN_SIGMA)
    ):
        return failed(
            nominal,
            FitStatus.TOO_DARK,
            f"The gain comes out as {curve.K_DN_per_e:.3g} ± {sigma_K:.2g} DN per electron: "
            "the flats hold too little shot noise.",
        )
    if curve.K_DN_per_e < 0:
        return failed(
            nominal,
            FitStatus.POOR_FIT,
            f"The variance of flats falls with their mean ({curve.K_DN_per_e:.3g} DN/e).",
        )
    if light.stack_clipped:
        median = float(np.median(data.flat_stack.mean_DN))
        return failed(nominal, FitStatus.SATURATED, f"The flat stack's median is {median:.4g} DN.")
    status = FitStatus.CONVERGED if dark.converged and light.transfer.converged else FitStatus.NOT_CONVERGED
    if light.transfer.chi2_dof > _WORST_CHI2 or light.bent_too_far:
        status = FitStatus.POOR_FIT
    return assemble(data, dark, light, status)
