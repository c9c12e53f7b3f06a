"""Noise fit: EMVA 1288's K, sigma_d, dark current, saturation, PRNU, DSNU; ELD's row noise and Tukey-lambda shape."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from udccal.fitting.noise.dark import DarkTerms, Unevenness, fit_dark_terms
from udccal.fitting.noise.dark_fit import start_values
from udccal.fitting.noise.data import NoiseData, NoiseMoments, reduced
from udccal.fitting.noise.flats import Curve, find_saturation, fit_curve, rough_gain, stacked
from udccal.fitting.noise.prnu import prnu, rough_median
from udccal.fitting.noise.report import assemble
from udccal.fitting.noise.rules import NoiseRules
from udccal.fitting.noise.transfer import linear_signal
from udccal.models.noise import Noise
from udccal.result import FitResult, FitStatus
from udccal.rig import RigDescription

# The dark fit wants the gain, the gain the dark fit: so often at most.
_MOST_ROUNDS = 5


def nominal_noise(rig: RigDescription) -> Noise:
    """Noise from the rig description alone: what a failed fit returns."""
    camera = rig.camera
    return assumed_noise(camera.K_DN_per_e.value, camera.black_DN.value, float(rig.saturation_DN))


def assumed_noise(K_DN_per_e: float, black_DN: float, saturation_DN: float) -> Noise:
    """What is taken for granted of a sensor of which only these are known."""
    return Noise(
        K_DN_per_e=K_DN_per_e,
        black_DN=black_DN,
        saturation_DN=saturation_DN,
        sigma_d_e=5.0,
        lambda_read=0.14,
        sigma_row_DN=0.0,
        q_DN=1.0,
        dark_current_e_per_s=0.0,
        DSNU1288_e=0.0,
        PRNU1288=0.0,
    )


def fit_noise(data: NoiseData, nominal: Noise | None = None, rules: NoiseRules | None = None) -> FitResult[Noise]:
    """Fit the noise term: K, black, saturation, dark noise and its shape, row noise, dark current, DSNU, PRNU.

    A curved response is found by itself: the result then has the estimate ``nonlinearity``, the share of the
    signal that is missing at full scale, and K is that of small signals.

    Args:
        data: frames as arrays, or as ``read_noise`` has them of a session.
        nominal: returned as the term where no fit is possible.
        rules: see ``NoiseRules``.

    Raises:
        FitError: when a frame is not a picture of codes like the others, or an exposure is no time.
        SessionError: when a file of the session is missing or damaged.
    """
    rules = rules or NoiseRules()
    moments = reduced(data, rules)
    nominal = nominal or assumed_noise(1.0, 0.0, moments.top_DN if moments else 4095.0)
    if moments is None:
        note = "Expected dark and bright pairs of frames, found none."
        return FitResult.failed("noise", nominal, FitStatus.TOO_FEW_DATA, note)
    return fit_moments(moments, nominal, rules)


def fit_moments(data: NoiseMoments, nominal: Noise, rules: NoiseRules) -> FitResult[Noise]:
    """Fit the noise term to frames that are reduced; ``nominal`` is returned as the term where no fit is possible."""
    refused = _too_little(data, rules)
    if refused:
        return FitResult.failed("noise", nominal, *refused)
    dark = fit_dark_terms(data, rough_gain(data), rules)
    curve = fit_curve(data, dark, rules)
    for _ in range(_MOST_ROUNDS):
        if curve.usable_levels < rules.levels or curve.K_DN_per_e <= 0 or not _gain_matters(data, dark, curve):
            break
        dark = fit_dark_terms(data, curve.K_DN_per_e, rules, dark)
        curve = fit_curve(data, dark, rules)
    refused = _no_black(data, dark, rules) or _no_gain(data, dark, curve, rules)
    if refused:
        return FitResult.failed("noise", nominal, *refused)
    uneven = _photo_response(data, dark, curve, rules)
    return assemble(data, dark, curve, find_saturation(data, dark, curve, rules), uneven, rules)


def _too_little(data: NoiseMoments, rules: NoiseRules) -> tuple[FitStatus, str] | None:
    """What can be refused at sight."""
    if len(data.darks) < 2 or len(data.flats) < rules.levels:
        found = f"{len(data.darks)} and {len(data.flats)}"
        note = f"Expected at least 2 dark and {rules.levels} flat exposures, found {found}."
        return FitStatus.TOO_FEW_DATA, note
    if any(pair.counts.sum() < 100 for pair in data.darks):
        return FitStatus.TOO_FEW_DATA, "A dark pair holds fewer than 100 samples of like codes."
    start = start_values(data.darks)
    brightest = max(float(np.median(flat.mean_DN)) for flat in data.flats) - float(start[0])
    if brightest < 0.05 * float(np.sqrt(start[2])):
        return FitStatus.TOO_DARK, f"The brightest flat lies {brightest:.3g} DN above black."
    if any(pair.edges_DN[-1] == np.inf and pair.counts[-1].sum() > 0.5 * pair.counts.sum() for pair in data.darks):
        return FitStatus.SATURATED, "Dark frames lie at the converter's largest code. Lower the black level."
    return None


def _gain_matters(data: NoiseMoments, dark: DarkTerms, curve: Curve) -> bool:
    """Whether another gain moves the dark current's shot noise by half of what the read noise is known to.

    To first order the photon transfer fit moves the read noise with the gain by itself.
    """
    longest = max(pair.exposure_s for pair in data.darks)
    moved = abs(curve.K_DN_per_e - dark.K_DN_per_e) * dark.dark_DN_per_s.value * longest
    return moved > 0.5 * float(np.sqrt(dark.read_DN2.variance))


def _no_black(data: NoiseMoments, dark: DarkTerms, rules: NoiseRules) -> tuple[FitStatus, str] | None:
    """Codes cut off at 0, and offsets of pixels far larger than their noise: no code tells where black is."""
    cut = any(pair.edges_DN[0] == -np.inf and pair.counts[0].sum() > 0.01 * pair.counts.sum() for pair in data.darks)
    quiet = max(dark.read_DN2.value + dark.row_DN2.value, 1e-9)
    if dark.white or not cut or dark.dsnu_DN2.value <= rules.offsets**2 * quiet:
        return None
    note = "Dark codes are cut off at 0 and show too little noise to tell black. Raise the black level."
    return FitStatus.POOR_FIT, note


def _no_gain(data: NoiseMoments, dark: DarkTerms, curve: Curve, rules: NoiseRules) -> tuple[FitStatus, str] | None:
    """Flats that are copies, too few, too dark, or clipped."""
    K, full_DN = curve.K_DN_per_e, max(curve.ceiling_DN - dark.black_DN, 1.0)
    above = stacked(data.flats, "mean_DN") - dark.black_DN
    lit = stacked(data.flats, "variance_DN2")[(above > 0) & (above < 0.9 * (curve.ceiling_DN - dark.black_DN))]
    if lit.size and float(np.median(lit)) < 0.3 * (dark.read_DN2.value + data.q_DN**2 / 12.0):
        return FitStatus.POOR_FIT, (
            f"Expected the variance of flats to grow with their mean, found a slope of {K:.3g} DN per electron: the "
            "two frames of a pair may be copies of each other."
        )
    if curve.usable_levels < rules.levels:
        return FitStatus.SATURATED if curve.full.any() else FitStatus.TOO_DARK, (
            f"Expected at least {rules.levels} flat exposures between the dark noise and 90 % of saturation, found "
            f"{curve.usable_levels}."
        )
    sigma = float(np.sqrt(curve.fit.cov[0, 0]))
    told = np.isfinite(sigma) and sigma > 0 and min(abs(K) / sigma, curve.shot_significance) >= rules.gain_sigma
    if not told:
        note = f"The gain comes out as {K:.3g} ± {sigma:.2g} DN per electron: the flats hold too little shot noise."
        return FitStatus.TOO_DARK, note
    if K < 0:
        return FitStatus.POOR_FIT, f"The variance of flats falls with their mean ({K:.3g} DN/e)."
    median = rough_median(data.flat_stack.mean_DN)
    if median > curve.ceiling_DN - 4 * float(np.sqrt(K * full_DN)):
        return FitStatus.SATURATED, f"The flat stack's median is {median:.4g} DN."
    return None


def _photo_response(data: NoiseMoments, dark: DarkTerms, curve: Curve, rules: NoiseRules) -> Unevenness:
    """PRNU from the stacks; the temporal variance that averaging left comes from the photon transfer curve."""
    K, V0, c = (float(v) for v in curve.fit.values[:3])
    bright, stack, rate = data.flat_stack, data.dark_stack, dark.dark_DN_per_s.value
    quiet = max(V0, 0.0) + data.q_DN**2 / 12.0
    at_no_light = (quiet + K * rate * bright.exposure_s) / bright.frames
    if dark.white:
        signal = bright.mean_DN.astype(np.float32) - stack.mean_DN.astype(np.float32)
        at_no_light += (quiet + K * rate * stack.exposure_s) / stack.frames
    else:
        # Dark codes that are cut off or coarse do not show the offsets: their variance is taken off instead.
        signal = bright.mean_DN.astype(np.float32) - np.float32(dark.black_DN + rate * bright.exposure_s)
        at_no_light += dark.dsnu_DN2.value
    level = max(rough_median(signal), 1e-6)
    z = float(linear_signal(np.array(level), c, K))
    steep = 1 - 2 * c * z
    found = prnu(signal, at_no_light, K * z * steep**2 / level / bright.frames, data.period, rules)
    # Where the response bends, a relative change of light is a smaller relative change of signal.
    scale = (level / (z * steep)) ** 2
    offsets = 0.0 if dark.white else float(np.sqrt(dark.dsnu_DN2.variance)) / level**2
    return replace(found, variance=found.variance * scale, sigma=float(np.hypot(found.sigma, offsets)) * scale)
