"""Noise fit: EMVA 1288's K, sigma_d, dark current, saturation, PRNU, DSNU; ELD's row noise and Tukey-lambda shape."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float

from udccal.fitting.engine.gaussian import Posterior
from udccal.fitting.engine.report import estimates, residual_sample
from udccal.fitting.noise.codes import start_values
from udccal.fitting.noise.dark import DarkTerms, Quantity, Unevenness, fit_dark_terms
from udccal.fitting.noise.data import NoiseData, NoiseMoments, reduced
from udccal.fitting.noise.flats import Curve, Saturation, find_saturation, fit_curve, rough_gain, stacked
from udccal.fitting.noise.moments import tiling
from udccal.fitting.noise.prnu import photo_response, rough_median
from udccal.fitting.noise.rules import NoiseRules
from udccal.models.noise import Noise
from udccal.result import Diagnostic, FitResult, FitStatus, Outliers
from udccal.rig import RigDescription

# The dark fit wants the gain, the gain the dark fit: so often at most.
_MOST_ROUNDS = 5


# The term's fields, and the share of the signal that is missing at full scale, where the data ask for it.
NAMES = (*Noise.__dataclass_fields__, "nonlinearity")
UNITS = ("DN/e", "DN", "DN", "e", "1", "DN", "DN", "e/s", "e", "1", "1")
_OF_TERM = 10


def nominal_noise(rig: RigDescription) -> Noise:
    """Noise from the rig description alone: what a failed fit returns."""
    return _assumed(rig.camera.K_DN_per_e.value, rig.camera.black_DN.value, float(rig.saturation_DN))


def _assumed(K_DN_per_e: float, black_DN: float, saturation_DN: float) -> Noise:
    """What is taken for granted of a sensor of which only these are known."""
    return _term(np.array([K_DN_per_e, black_DN, saturation_DN, 5.0, 0.14, 0.0, 1.0, 0.0, 0.0, 0.0]))


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
    nominal = nominal or _assumed(1.0, 0.0, moments.top_DN if moments else 4095.0)
    if moments:
        return fit_moments(moments, nominal, rules)
    note = "Expected dark and bright pairs of frames, found none."
    return FitResult.failed("noise", nominal, FitStatus.TOO_FEW_DATA, note)


def mean_response(result: FitResult[Noise], light: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Mean signal above black in DN that the fitted response predicts; where it would pass saturation, saturation.

    Args:
        result: of the noise fit (EMVA 1288, clause 6.7, judges the response).
        light: in the unit of the fitted levels (photons per pixel, or seconds).
    """
    numbers = {item.name: item.value for item in result.diagnostics}
    K, black_DN, top_DN = (float(np.asarray(getattr(result.term, name))) for name in NAMES[:3])
    linear = numbers["response_DN_per_light"] * (np.asarray(light) + numbers["light_offset"])
    bent = linear - numbers["curvature"] * (linear**2 + K * linear)
    return np.asarray(np.minimum(bent, top_DN - black_DN))


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
    refused = _no_gain(data, dark, curve, rules)
    if refused:
        return FitResult.failed("noise", nominal, *refused)
    uneven = photo_response(data, dark, curve, rules)
    return _assembled(data, dark, curve, find_saturation(data, dark, curve, rules), uneven, rules)


def _too_little(data: NoiseMoments, rules: NoiseRules) -> tuple[FitStatus, str] | None:
    """What can be refused at sight."""
    if len(data.darks) < 2 or len(data.flats) < rules.levels:
        wanted, found = f"2 dark and {rules.levels} flat", f"{len(data.darks)} and {len(data.flats)}"
        return FitStatus.TOO_FEW_DATA, f"Expected at least {wanted} exposures, found {found}."
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


def _no_gain(data: NoiseMoments, dark: DarkTerms, curve: Curve, rules: NoiseRules) -> tuple[FitStatus, str] | None:
    """Darks that do not show black; flats that are copies, too few, too dark, or clipped."""
    # Codes cut off at 0, and offsets of pixels far larger than their noise: no code tells where black is.
    cut = any(pair.edges_DN[0] == -np.inf and pair.counts[0].sum() > 0.01 * pair.counts.sum() for pair in data.darks)
    quiet = max(dark.read_DN2.value + dark.row_DN2.value, 1e-9)
    if cut and not dark.white and dark.dsnu_DN2.value > rules.offsets**2 * quiet:
        note = "Dark codes are cut off at 0 and show too little noise to tell black. Raise the black level."
        return FitStatus.POOR_FIT, note
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


def _assembled(
    data: NoiseMoments, dark: DarkTerms, curve: Curve, saturation: Saturation, uneven: Unevenness, rules: NoiseRules
) -> FitResult[Noise]:
    """The result of a fit that went through; ``uneven`` is the variance of the relative response of pixels."""
    fit, response = curve.fit, curve.choice
    assert response is not None, "a fit that went through has a curve"
    prnu = Quantity.asked("PRNU", uneven.variance, uneven.sigma**2, uneven.samples)
    values, cov = _values(data, dark, curve, saturation, prnu)
    bent_too_far = abs(float(fit.values[2])) * max(curve.ceiling_DN - dark.black_DN, 1.0) >= 0.999 * rules.most_bent
    status = FitStatus.CONVERGED if dark.fit.converged and fit.converged else FitStatus.NOT_CONVERGED
    if fit.chi2_dof > rules.worst_chi2 or bent_too_far:
        status = FitStatus.POOR_FIT
    shown = len(NAMES) if fit.order.curved else _OF_TERM
    terms = (dark.row_DN2, dark.shape, dark.dark_DN_per_s, dark.dsnu_DN2, prnu)
    used = np.isfinite(fit.variance_z)
    height, width = data.flat_stack.mean_DN.shape
    tiles = tiling(height, width, data.period, rules)
    pixels = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    places = np.column_stack([tiles.means(of).ravel() for of in pixels])
    return FitResult(
        name="noise",
        term=_term(values[:_OF_TERM]),
        status=status,
        estimates=estimates(NAMES[:shown], UNITS[:shown], values[:shown], cov[:shown, :shown]),
        cov=cov[:shown, :shown],
        chi2_dof=fit.chi2_dof,
        samples=curve.bins + dark.samples,
        candidates=(
            *(candidate for term in terms for candidate in term.candidates),
            *(candidate for candidate in response.candidates if np.isfinite(candidate.criterion)),
        ),
        diagnostics=_diagnostics(data, dark, curve, saturation),
        notes=tuple(_notes(dark, curve, saturation, float(values[-1]), bent_too_far)),
        outliers=tuple(one for one in _outliers(data, dark, curve, saturation, uneven, rules) if one.count),
        residuals=residual_sample(places[np.nonzero(used)[1]], fit.variance_z[used]),
        posterior=Posterior.from_cov(values[:_OF_TERM], cov[:_OF_TERM, :_OF_TERM], _term),
    )


def _term(values: Float[np.ndarray, "10"]) -> Noise:
    return Noise(*(float(value) for value in values))


def _root(of: Quantity) -> tuple[float, float]:
    """Standard deviation from a variance, and its slope.

    Where the variance is lost in its error the root is that far from zero at most, not to first order.
    """
    value, error = float(np.sqrt(max(of.value, 0.0))), float(np.sqrt(of.variance))
    return value, 0.5 / value if value**2 > error else float(1 / np.sqrt(max(error, 1e-300)))


def _values(
    data: NoiseMoments, dark: DarkTerms, curve: Curve, saturation: Saturation, prnu: Quantity
) -> tuple[Float[np.ndarray, "11"], Float[np.ndarray, "11 11"]]:
    """The estimates and their covariance, from that of what was fitted."""
    (K, V0, c), transfer = (float(v) for v in curve.fit.values[:3]), curve.fit.cov[:3, :3]
    total = Quantity(V0 + dark.row_DN2.value, float(transfer[1, 1]) + dark.row_DN2.variance)
    roots = [_root(one) for one in (total, dark.row_DN2, dark.dsnu_DN2, prnu)]
    (sigma_d, by_total), (row, by_row), (spread, by_spread), (response, by_response) = roots
    rate, full_DN = dark.dark_DN_per_s.value, saturation.level_DN - dark.black_DN
    values = np.array([K, dark.black_DN, saturation.level_DN, sigma_d / K, dark.shape.value, row, data.q_DN, rate / K,
                       spread / K, response, c * full_DN])  # fmt: skip
    # Inner quantities: K, V0, c, sigma_row^2, black, rate, saturation, shape, DSNU^2, PRNU^2.
    inner = np.diag([0.0] * 6 + [saturation.sigma_DN**2, dark.shape.variance, dark.dsnu_DN2.variance, prnu.variance])
    inner[:3, :3], inner[3, 3], inner[4:6, 4:6] = transfer, dark.row_DN2.variance, dark.levels_cov
    if 0 < saturation.level_DN < data.top_DN:
        inner[[4, 6, 6], [6, 4, 6]] += dark.pixels_DN2
    jacobian = np.zeros((11, 10))
    jacobian[[0, 1, 2, 4], [0, 4, 6, 7]] = 1.0
    jacobian[3, [0, 1, 3]] = -sigma_d / K**2, by_total / K, by_total / K
    jacobian[5, 3], jacobian[9, 9] = by_row, by_response
    jacobian[7, [0, 5]] = -rate / K**2, 1 / K
    jacobian[8, [0, 8]] = -spread / K**2, by_spread / K
    jacobian[10, [2, 4, 6]] = full_DN, -c, c
    return values, jacobian @ inner @ jacobian.T


def _diagnostics(data: NoiseMoments, dark: DarkTerms, curve: Curve, saturation: Saturation) -> tuple[Diagnostic, ...]:
    values, scatter = curve.fit.values, curve.fit.scatter
    numbers = (
        ("photon_transfer_bins", curve.bins, "1"),
        ("photon_transfer_levels", curve.usable_levels, "1"),
        ("photon_transfer_up_to", curve.fit_up_to, "1"),
        ("V0_DN2", values[1], "DN^2"),
        ("saturated_bins", saturation.bins, "1"),
        ("curvature", values[2], "1/DN"),
        ("response_DN_per_light", values[3], "DN"),
        ("light_offset", values[4], "light"),
        ("light_scatter", scatter, "1"),
        ("dark_samples_outside_histogram", sum(pair.outside for pair in data.darks), "1"),
        ("edge_gain", np.sqrt(np.mean(dark.fit.edge_gains**2)), "1"),
    )
    return tuple(Diagnostic(name, float(value), unit) for name, value, unit in numbers)


def _outliers(
    data: NoiseMoments, dark: DarkTerms, curve: Curve, saturation: Saturation, uneven: Unevenness, rules: NoiseRules
) -> Iterable[Outliers]:
    def named(levels: tuple[int, ...]) -> tuple[str, ...]:
        stack = len(data.flats)
        return tuple("flat stack" if i >= stack else f"flat {i} ({data.flats[i].exposure_s:.4g} s)" for i in levels)[:8]

    # Among clipped samples those that are not stand out; that is no defect.
    ceiling = saturation.level_DN - 0.1 * (curve.ceiling_DN - dark.black_DN)
    hits = sum(flat.outliers for flat in data.flats if float(flat.mean_DN.max()) < ceiling)
    hits += sum(moments.outliers for moments in data.dark_moments)
    sigma, flickering, off = f"{rules.outlier_sigma:g} robust sigma", curve.flickering, curve.levels_left_out
    yield Outliers(f"two codes of a pixel {rules.hit_sigma:g} sigma apart in a pair (hits, blinking pixels)", hits)
    yield Outliers(f"flats of a pair that differ in brightness by {sigma}", len(flickering), named(flickering))
    yield Outliers(f"brightness off the response by {sigma}", len(off), named(off))
    yield Outliers(f"bins of flats off the photon transfer curve by {sigma}", curve.bins_left_out)
    for what, found in (("averaged dark pixels", dark.defects), ("averaged flat pixels", uneven)):
        beside = "(hot)" if found is dark.defects else "their surroundings"
        places = tuple(f"row {row}, column {column}" for row, column in found.places)
        yield Outliers(f"{what} {rules.defect_sigma:g} robust sigma off {beside}", found.outliers, places)


def _notes(
    dark: DarkTerms, curve: Curve, saturation: Saturation, nonlinearity: float, bent_too_far: bool
) -> Iterable[str]:
    if not saturation.bins:
        level = saturation.level_DN
        yield f"No flat reached saturation; the converter's largest code, {level:.0f} DN, is taken for it."
    if not dark.white:
        yield "Rounding or cut-off codes bend the dark codes; black and DSNU come from the histograms."
    if curve.fit.order.curved:
        yield f"The response bends: {100 * nonlinearity:.2g} % of the signal is missing at full scale."
    if bent_too_far:
        yield "The response bends more than the model can say. Check the exposures and the lamp."
    if curve.fit_up_to < 0.9:
        yield f"Flats above {100 * curve.fit_up_to:.0f} % of saturation do not follow the curve and are left out."
    if curve.fit.order.unsteady:
        yield f"The light differs by {100 * curve.fit.scatter:.2g} % from level to level."
