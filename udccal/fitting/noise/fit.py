"""Noise fit: EMVA 1288's K, sigma_d, dark current, saturation, PRNU, DSNU; ELD's row noise and Tukey-lambda shape."""

from __future__ import annotations

from dataclasses import replace
from itertools import compress

import numpy as np
from jaxtyping import Float

from udccal.arguments import check_optional
from udccal.errors import FitError
from udccal.fitting.engine.gaussian import Posterior
from udccal.fitting.engine.orders import Quantity
from udccal.fitting.engine.report import estimates, residual_sample
from udccal.fitting.noise.codes import Five, start_values
from udccal.fitting.noise.contradictions import contradiction
from udccal.fitting.noise.dark import fit_dark_terms
from udccal.fitting.noise.dark_noise import unlike_exposures, with_own_noise
from udccal.fitting.noise.data import NoiseData, NoiseRules
from udccal.fitting.noise.flats import Curve, fit_curve, shared_by_neighbours
from udccal.fitting.noise.frame_moments import bins, stacked
from udccal.fitting.noise.moments import NoiseMoments, reduced, rough_gain
from udccal.fitting.noise.notes import left_out, notes
from udccal.fitting.noise.patterns import DarkTerms, Pattern, prnu, rough_median
from udccal.fitting.noise.response import linear_mean, steepness, temporal_variance
from udccal.fitting.noise.saturation import find_saturation
from udccal.models.noise import Noise
from udccal.numerics import in_float64
from udccal.result import Diagnostic, FitResult, FitStatus
from udccal.rig import RigDescription

# The last one, the fraction of the signal that is missing at full scale, is estimated where the data ask for it.
NAMES = tuple(Noise.__dataclass_fields__)


def nominal_noise(rig: RigDescription) -> Noise:
    """Noise from the rig description alone, the term of a failed fit; ``rig`` gives K, black and saturation."""
    return _assumed(rig.camera.K_DN_per_e.value, rig.camera.black_DN.value, float(rig.saturation_DN))


def _assumed(K_DN_per_e: float, black_DN: float, saturation_DN: float) -> Noise:
    """The noise assumed for a sensor of which only these numbers are known."""
    return Noise(K_DN_per_e, black_DN, saturation_DN, 5.0, 0.14, 0.0, 1.0, 0.0, 0.0, 0.0)


@in_float64
def fit_noise(data: NoiseData, nominal: Noise | None = None, rules: NoiseRules | None = None) -> FitResult[Noise]:
    """Fit the noise term: K, black, saturation, dark noise and its shape, row noise, dark current, DSNU, PRNU.

    The fit detects a curved response. The result then has the estimate ``nonlinearity``, the fraction of the signal
    that is missing at full scale, and K is that of small signals.

    Args:
        data: frames as arrays, or from a session by ``read_noise``.
        nominal: returned as the term where no fit is possible.
        rules: see ``NoiseRules``.

    Returns:
        the term with its status; a fit that is not possible says why in its notes.

    Raises:
        FitError: when an argument is of another kind, a frame is not a picture of codes like the others or cannot be
            loaded, or an exposure is not a time.
        SessionError: when a file of the session is missing or damaged.
    """
    check_optional(nominal, Noise, FitError)
    check_optional(rules, NoiseRules, FitError)
    moments = reduced(data, rules or NoiseRules())
    nominal = nominal or _assumed(1.0, 0.0, moments.top_DN if moments else 4095.0)
    if moments:
        return fit_moments(moments, nominal)
    note = "Expected dark and bright pairs of frames, found none."
    return FitResult.failed("noise", nominal, FitStatus.TOO_FEW_DATA, note)


def fit_moments(data: NoiseMoments, nominal: Noise) -> FitResult[Noise]:
    """Fit the noise term to frames that are reduced; ``nominal`` is returned as the term where no fit is possible."""
    start = start_values(data.darks) if data.darks else np.zeros(5)
    if refused := _too_little(data, start):
        return FitResult.failed("noise", nominal, *refused)
    dark = fit_dark_terms(data, rough_gain(data, float(start[0]), float(start[2])), start)
    curve = fit_curve(data, dark)
    below = [float(np.median(of.mean_DN + 4 * of.spread_DN)) < curve.ceiling_DN for of in data.dark_moments]
    if curve.full.any() and 2 <= sum(below) < len(below):
        darks, moments = compress(data.darks, below), compress(data.dark_moments, below)
        result = fit_moments(replace(data, darks=tuple(darks), dark_moments=tuple(moments)), nominal)
        note = f"{len(below) - sum(below)} dark exposures are left out: dark current nearly fills the pixels."
        return replace(result, notes=(note, *result.notes))
    longest = max(pair.exposure_s for pair in data.darks)
    # The dark fit needs the gain, and the gain the dark fit. To first order the curve corrects the read noise for the
    # gain; a second round is for a gain that moves dark current's shot noise by half of the read noise's sigma, or
    # for a curvature that moves black by half of its own.
    for _ in range(30):
        (K, _, c), signal = curve.values[:3].tolist(), dark.dark_DN_per_s.value * longest
        moved = abs(K - dark.K_DN_per_e) * signal > 0.5 * dark.read_DN2.variance**0.5
        moved |= abs(c - dark.curvature) * signal**2 > 0.5 * float(dark.levels_cov[0, 0]) ** 0.5
        if curve.usable_levels < data.rules.levels or K <= 0 or not moved:
            break
        dark = fit_dark_terms(data, K, dark.fit.values, c)
        curve = fit_curve(data, dark)
    refused = _no_gain(data, dark, curve)
    if not refused and (own := with_own_noise(data, dark, float(curve.cov[0, 0]) ** 0.5)) is not dark:
        dark, curve = own, fit_curve(data, own)
        refused = _no_gain(data, dark, curve)
    return FitResult.failed("noise", nominal, *refused) if refused else _assembled(data, dark, curve)


def _too_little(data: NoiseMoments, start: Five) -> tuple[FitStatus, str] | None:
    """The status and sentence of data that cannot be fitted; None where the fit may begin from ``start``."""
    darks, flats, least = len(data.darks), len(data.flats), data.rules.levels
    if darks < 2 or flats < least:
        found = f"found {darks} and {flats}"
        return FitStatus.TOO_FEW_DATA, f"Expected at least 2 dark and {least} flat exposures, {found}."
    if any(pair.counts.sum() < 100 for pair in data.darks):
        return FitStatus.TOO_FEW_DATA, "A dark pair holds fewer than 100 samples of like codes."
    brightest = max(float(np.median(flat.mean_DN)) for flat in data.flats) - float(start[0])
    if brightest < 0.05 * float(np.sqrt(start[2])):
        return FitStatus.TOO_DARK, f"The brightest flat lies {brightest:.3g} DN above black."
    if wrong := contradiction(data):
        return FitStatus.POOR_FIT, wrong
    if any(pair.edges_DN[-1] == np.inf and pair.counts[-1].sum() > 0.5 * pair.counts.sum() for pair in data.darks):
        return FitStatus.SATURATED, "Dark frames lie at the converter's largest code. Lower the black level."
    return None


def _no_gain(data: NoiseMoments, dark: DarkTerms, curve: Curve) -> tuple[FitStatus, str] | None:
    """Status and sentence where darks show no black or other exposures, or flats are copies, too few, dark or full."""
    # With codes cut off at 0 and offsets of pixels far larger than their noise, no code shows black.
    cut = any(pair.edges_DN[0] == -np.inf and pair.counts[0].sum() > 0.01 * pair.counts.sum() for pair in data.darks)
    quiet = max(dark.read_DN2.value + dark.row_DN2.value, 1e-9)
    if cut and not dark.white and dark.dsnu_DN2.value > 30.0**2 * quiet:
        note = "Dark codes are cut off at 0 and show too little noise to find black. Raise the black level."
        return FitStatus.POOR_FIT, note
    full_DN, K = curve.ceiling_DN - dark.black_DN, float(curve.values[0])
    above, levels, least = stacked(data.flats, "mean_DN") - dark.black_DN, curve.levels, data.rules.levels
    lit = stacked(data.flats, "variance_DN2")[(above > 0) & (above < 0.9 * full_DN)]
    if lit.size and float(np.median(lit)) < 0.3 * (dark.read_DN2.value + data.rounding_DN2):
        found = f"found a slope of {K:.3g} DN per electron: the two frames of a pair may be copies of each other"
        return FitStatus.POOR_FIT, f"Expected the variance of flats to grow with their mean, {found}."
    if curve.usable_levels < least:
        wanted = f"at least {least} flat exposures between the dark noise and 90 % of saturation"
        status = FitStatus.SATURATED if curve.full.any() else FitStatus.TOO_DARK
        return status, f"Expected {wanted}, found {curve.usable_levels}."
    # Shot noise of the light in all bins, in sigma of their variances.
    shot = K * (levels.mean_DN - levels.dark_DN[:, None]) / np.maximum(levels.variance_DN2, 1e-9)
    significance = float(np.sqrt(np.sum((levels.dof / 2 * shot**2)[levels.usable])))
    sigma = float(np.sqrt(curve.fit.cov[0, 0]))
    if not (0 < sigma < np.inf and min(abs(K) / sigma, significance) >= data.rules.gain_sigma):
        note = f"The gain comes out as {K:.3g} ± {sigma:.2g} DN per electron: the flats hold too little shot noise."
        return FitStatus.TOO_DARK, note
    if K < 0:
        return FitStatus.POOR_FIT, f"The variance of flats falls with their mean ({K:.3g} DN/e)."
    median = rough_median(data.flat_stack.mean_DN)
    if median > curve.ceiling_DN - 4 * float(np.sqrt(K * max(full_DN, 1.0))):
        return FitStatus.SATURATED, f"The flat stack's median is {median:.4g} DN."
    if dark.white and unlike_exposures(data, dark):
        note = "The noise of dark frames does not rise with exposure as dark current's would. Check exposure times."
        return FitStatus.POOR_FIT, note
    return None


def _photo_response(data: NoiseMoments, dark: DarkTerms, curve: Curve) -> Pattern:
    """PRNU from the stacks; the photon transfer curve gives the temporal variance of the averages."""
    K, V0, c, *_, gain_noise2, d = curve.values.tolist()
    bright, stack, rate = data.flat_stack, data.dark_stack, dark.dark_DN_per_s.value
    quiet = max(V0, 0.0) + data.rounding_DN2
    at_no_light = (quiet + dark.shot_DN2(K, bright.exposure_s)) / bright.frames
    if dark.white:
        signal = bright.mean_DN.astype(np.float32) - stack.mean_DN.astype(np.float32)
        at_no_light += (quiet + dark.shot_DN2(K, stack.exposure_s)) / stack.frames
    else:
        # Dark codes that are cut off or coarse do not show the offsets: the offsets' variance is subtracted instead.
        signal = bright.mean_DN.astype(np.float32) - np.float32(dark.black_DN + rate * bright.exposure_s)
        at_no_light += dark.dsnu_DN2.value
    level = max(rough_median(signal), 1e-6)
    z = float(linear_mean(*np.array([[level], [c], [d], [K]]))[0])
    steep = steepness(z, c, d)
    shot = temporal_variance(z, K, 0.0, c, 0.0, gain_noise2, d) / level / bright.frames
    found = prnu(signal, at_no_light, shot, data.period, data.rules.defect_sigma)
    # Where the response bends, a relative change of light is a smaller relative change of signal.
    scale = (level / (z * steep)) ** 2
    offsets = 0.0 if dark.white else float(np.sqrt(dark.dsnu_DN2.variance)) / level**2
    return replace(found, variance=found.variance * scale, sigma=float(np.hypot(found.sigma, offsets)) * scale)


def _assembled(data: NoiseMoments, dark: DarkTerms, curve: Curve) -> FitResult[Noise]:
    """The result of a finished fit."""
    fit, response, rules = curve.fit, curve.choice, data.rules
    assert response is not None, "a fit that went through has a curve"
    saturation, uneven = find_saturation(data, dark, curve), _photo_response(data, dark, curve)
    PRNU2 = Quantity.asked("PRNU", uneven.variance, uneven.sigma**2, uneven.samples)
    values, cov = _values(data, dark, curve, saturation, PRNU2)
    full_DN = max(curve.ceiling_DN - dark.black_DN, 1.0)
    # Gain noise beyond shot noise is no sensor's: the lamp's pattern changes.
    unsteady = bool(fit.values[5] * full_DN > fit.values[0])
    shared = shared_by_neighbours(data, curve)
    linked = shared.found and abs(shared.gain_factor - 1) > rules.most_shared
    poor = fit.misfit.ratio > rules.worst_chi2 or fit.at_bound or linked or unsteady
    converged = dark.fit.converged or dark.foreign
    status = FitStatus.CONVERGED if fit.converged and converged else FitStatus.NOT_CONVERGED
    shown = len(NAMES) - (not fit.order.curved)
    terms = (dark.row_DN2, dark.columns.DN2, dark.dark_DN_per_s, dark.dsnu_DN2, PRNU2)
    candidates = [*(one for term in terms for one in term.candidates), *response.candidates]
    outside = len(data.darks) * data.flat_stack.mean_DN.size - data.dark_samples
    height, width = data.flat_stack.mean_DN.shape
    (down, right), used = bins(height, width, data.period), np.isfinite(fit.variance_z)
    x, y = np.arange(width) @ right / right.sum(axis=0), down @ np.arange(height) / down.sum(axis=1)
    places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    return FitResult(
        name="noise",
        term=_term(values[:shown]),
        status=FitStatus.POOR_FIT if poor else status,
        estimates=estimates("noise", NAMES[:shown], values[:shown], cov[:shown, :shown]),
        cov=cov[:shown, :shown],
        chi2_dof=fit.misfit.ratio,
        samples=int(curve.levels.usable.sum()) + data.dark_samples,
        candidates=tuple(candidate for candidate in candidates if np.isfinite(candidate.criterion)),
        diagnostics=(
            Diagnostic("photon_transfer_bins", float(curve.levels.usable.sum()), "1"),
            Diagnostic("photon_transfer_levels", float(curve.usable_levels), "1"),
            Diagnostic("photon_transfer_up_to", curve.fit_up_to, "1"),
            Diagnostic("saturated_bins", float(curve.full.sum()), "1"),
            Diagnostic("curvature", float(fit.values[2]), "1/DN"),
            Diagnostic("curvature_growth", float(fit.values[6]), "1/DN^2"),
            Diagnostic("response_DN_per_light", float(fit.values[3]), "DN"),
            Diagnostic("light_offset", float(fit.values[4]), "light"),
            Diagnostic("light_scatter", fit.scatter, "1"),
            Diagnostic("gain_noise", float(fit.values[5]) ** 0.5, "1"),
            Diagnostic("flat_structure", uneven.structure2**0.5, "1"),
            Diagnostic("dark_samples_outside_histogram", float(outside), "1"),
            Diagnostic("edge_gain", float(np.sqrt(np.mean(dark.fit.edge_gains**2))), "1"),
        ),
        notes=tuple(notes(data, dark, curve, uneven, shared, values)),
        outliers=tuple(one for one in left_out(data, dark, curve, uneven, float(values[2])) if one.count),
        residuals=residual_sample(places[np.nonzero(used)[1]], fit.variance_z[used]),
        posterior=Posterior.from_cov(values[:shown], cov[:shown, :shown], _term),
    )


def _term(values: Float[np.ndarray, " shown"]) -> Noise:
    return Noise(*values.tolist())


def _values(
    data: NoiseMoments, dark: DarkTerms, curve: Curve, saturation: tuple[float, float], PRNU2: Quantity
) -> tuple[Float[np.ndarray, "11"], Float[np.ndarray, "11 11"]]:
    """The estimates, and their covariance from that of the fitted quantities."""
    K, V0, c, *_, d = curve.values.tolist()
    picked = [0, 1, 2, 6]
    transfer = curve.cov[np.ix_(picked, picked)]
    total = Quantity(V0 + dark.row_DN2.value, float(transfer[1, 1]) + dark.row_DN2.variance)
    roots = [one.root() for one in (total, dark.row_DN2, dark.dsnu_DN2, PRNU2)]
    (sigma_d, by_total), (row, by_row), (spread, by_spread), (response, by_response) = roots
    (level, level_sigma), rate = saturation, dark.dark_DN_per_s.value
    full_DN = level - dark.black_DN
    values = np.array([K, dark.black_DN, level, sigma_d / K, dark.shape.value, row, data.q_DN, rate / K, spread / K,
                       response, (c + d * full_DN) * full_DN])  # fmt: skip
    # Inner quantities: K, V0, c, d, sigma_row^2, black, rate, saturation, shape, DSNU^2, PRNU^2.
    inner = np.diag([0.0] * 7 + [level_sigma**2, dark.shape.variance, dark.dsnu_DN2.variance, PRNU2.variance])
    inner[:4, :4], inner[4, 4], inner[5:7, 5:7] = transfer, dark.row_DN2.variance, dark.levels_cov
    jacobian, steeper = np.zeros((11, 11)), c + 2 * d * full_DN
    jacobian[[0, 1, 2, 4], [0, 5, 7, 8]] = 1.0
    jacobian[3, [0, 1, 4]] = -sigma_d / K**2, by_total / K, by_total / K
    jacobian[5, 4], jacobian[9, 10] = by_row, by_response
    jacobian[7, [0, 6]] = -rate / K**2, 1 / K
    jacobian[8, [0, 9]] = -spread / K**2, by_spread / K
    jacobian[10, [2, 3, 5, 7]] = full_DN, full_DN**2, -steeper, steeper
    cov = jacobian @ inner @ jacobian.T
    if dark.own_shot_DN2_per_s:
        # The term has the mean's dark current; the noise's may be the sensor's.
        cov[7, 7] += (rate / K - dark.own_shot_DN2_per_s.value / K**2) ** 2
    return values, cov
