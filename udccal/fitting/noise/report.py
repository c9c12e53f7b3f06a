"""Dark and light terms to one result: ten numbers with their covariance, candidates, outliers, diagnostics, notes."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float

from udccal.fitting.engine.gaussian import Posterior
from udccal.fitting.engine.report import estimates, residual_sample
from udccal.fitting.noise.dark import DarkTerms, Quantity, Unevenness
from udccal.fitting.noise.data import NoiseMoments
from udccal.fitting.noise.flats import Curve, Saturation
from udccal.fitting.noise.moments import tiling
from udccal.fitting.noise.rules import NoiseRules
from udccal.models.noise import Noise
from udccal.result import Diagnostic, FitResult, FitStatus, Outliers

# The last estimate, the share of the signal that is missing at full scale, where the data ask for it.
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
    "nonlinearity",
)
UNITS = ("DN/e", "DN", "DN", "e", "1", "DN", "DN", "e/s", "e", "1", "1")
_OF_TERM = 10


def assemble(
    data: NoiseMoments, dark: DarkTerms, curve: Curve, saturation: Saturation, uneven: Unevenness, rules: NoiseRules
) -> FitResult[Noise]:
    """The result of a fit that went through.

    Args:
        data: the frames, reduced.
        dark: what dark frames tell.
        curve: photon transfer and response.
        saturation: where the signal stops.
        uneven: variance of the relative response of pixels.
        rules: what is a poor fit.
    """
    fit, response = curve.fit, curve.choice
    assert response is not None, "a fit that went through has a curve"
    prnu = Quantity.asked("PRNU", uneven.variance, uneven.sigma**2, uneven.samples)
    values, cov = _values(data, dark, curve, saturation, prnu)
    bent_too_far = abs(float(fit.values[2])) * max(curve.ceiling_DN - dark.black_DN, 1.0) >= 0.999 * rules.most_bent
    status = FitStatus.CONVERGED if dark.fit.converged and fit.converged else FitStatus.NOT_CONVERGED
    if fit.chi2_dof > rules.worst_chi2 or bent_too_far:
        status = FitStatus.POOR_FIT
    posterior = Posterior.from_cov(values[:_OF_TERM], cov[:_OF_TERM, :_OF_TERM], _term)
    shown = len(NAMES) if fit.order.curved else _OF_TERM
    terms = (dark.row_DN2, dark.shape, dark.dark_DN_per_s, dark.dsnu_DN2, prnu)
    used = np.isfinite(fit.variance_z)
    places = tiling(*data.flat_stack.mean_DN.shape, data.period, rules).centres_px
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
        posterior=posterior,
    )


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


def _term(values: Float[np.ndarray, "10"]) -> Noise:
    return Noise(**{name: float(value) for name, value in zip(NAMES, values, strict=False)})


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
        ("dark_fit_iterations", dark.fit.iterations, "1"),
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
