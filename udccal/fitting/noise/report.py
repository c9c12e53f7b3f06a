"""Dark and light terms to one result: ten numbers with their covariance, candidates, outliers, diagnostics, notes."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from udccal.fitting.noise import nonuniformity
from udccal.fitting.noise.dark import DarkTerms
from udccal.fitting.noise.data import NoiseData
from udccal.fitting.noise.levels import OUTLIER_SIGMA
from udccal.fitting.noise.light import LightTerms
from udccal.fitting.noise.tiling import tiling
from udccal.models.noise import Noise
from udccal.result import Candidate, Diagnostic, Estimate, FitResult, FitStatus, Outliers, ResidualSample

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
# The eleventh estimate, where the data ask for it: the share of the signal that is missing at full scale.
NONLINEARITY = "nonlinearity"
_MOST_RESIDUALS = 6000


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


def failed(nominal: Noise, status: FitStatus, note: str) -> FitResult[Noise]:
    """The nominal term, with the reason and the advice."""
    return FitResult.failed("noise", nominal, status, note)


def assemble(data: NoiseData, dark: DarkTerms, light: LightTerms, status: FitStatus) -> FitResult[Noise]:
    """The result of a fit that went through."""
    values, cov = _values(data, dark, light)
    names: tuple[str, ...] = (*NAMES, NONLINEARITY)
    units: tuple[str, ...] = (*UNITS, "1")
    if not light.curve.order.curved:
        names, units, values, cov = NAMES, UNITS, values[:-1], cov[:-1, :-1]
    sigma = np.sqrt(np.maximum(np.diag(cov), 0.0))
    return FitResult(
        name="noise",
        term=Noise(**{name: float(value) for name, value in zip(NAMES, values, strict=False)}),
        status=status,
        estimates=tuple(
            Estimate(name, float(value), float(one), unit)
            for name, value, one, unit in zip(names, values, sigma, units, strict=True)
        ),
        cov=cov,
        chi2_dof=light.transfer.chi2_dof,
        samples=light.curve.bins + dark.samples,
        candidates=(*dark.candidates, *_prnu_candidates(light), *_response_candidates(light)),
        diagnostics=_diagnostics(data, dark, light),
        notes=_notes(data, dark, light),
        outliers=_outliers(data, dark, light),
        residuals=_residuals(data, light),
    )


def _root(variance: float, its_variance: float, there: bool = True) -> tuple[float, float]:
    """Standard deviation from a variance, with its own variance.

    Where the variance is lost in its error the root is that far from zero at most, not to first order.
    """
    value = float(np.sqrt(max(variance, 0.0))) if there else 0.0
    error = float(np.sqrt(its_variance))
    return value, (error / (2 * value)) ** 2 if value**2 > error else error


def _values(
    data: NoiseData, dark: DarkTerms, light: LightTerms
) -> tuple[Float[np.ndarray, "11"], Float[np.ndarray, "11 11"]]:
    K, V0, c = (float(v) for v in light.transfer.values[:3])
    row, row_variance = _root(dark.row_DN2.value, dark.row_DN2.variance, dark.row_DN2.there)
    spread, spread_variance = _root(dark.dsnu_DN2.value, dark.dsnu_DN2.variance, dark.dsnu_DN2.there)
    uneven, uneven_variance = _root(light.prnu.variance, light.prnu.sigma**2, prnu_gain(light) > prnu_penalty(light))
    total = V0 + dark.row_DN2.value
    total_variance = float(light.transfer.cov[1, 1]) + dark.row_DN2.variance
    sigma_d, sigma_d_variance = _root(total, total_variance)
    rate = dark.dark_DN_per_s.value
    values = np.array(
        [
            K,
            dark.black_DN,
            light.saturation.level_DN,
            sigma_d / K,
            dark.shape.value,
            row,
            data.q_DN,
            rate / K,
            spread / K,
            uneven,
            c * (light.saturation.level_DN - dark.black_DN),
        ]
    )
    # Inner quantities: K, V0, c, sigma_row^2, black, rate, saturation, shape, DSNU, PRNU.
    inner = np.zeros((10, 10))
    inner[:3, :3] = light.transfer.cov[:3, :3]
    inner[3, 3] = dark.row_DN2.variance
    inner[4:6, 4:6] = dark.levels_cov
    of_pixels = dark.pixels_DN2 if 0 < light.saturation.level_DN < data.top_DN else 0.0
    inner[6, 6] = light.saturation.sigma_DN**2 + of_pixels
    inner[4, 6] = inner[6, 4] = of_pixels
    inner[7, 7], inner[8, 8], inner[9, 9] = dark.shape.variance, spread_variance, uneven_variance
    jacobian = np.zeros((11, 10))
    jacobian[[0, 1, 2, 4, 8, 9], [0, 4, 6, 7, 8, 9]] = 1.0
    jacobian[8, 8] = 1 / K
    jacobian[7, 5] = 1 / K
    by_total = np.sqrt(sigma_d_variance / max(total_variance, 1e-300)) / K
    jacobian[3, [1, 3]] = by_total
    by_row = np.sqrt(row_variance / max(dark.row_DN2.variance, 1e-300))
    jacobian[5, 3] = by_row
    jacobian[[3, 7, 8], 0] = -values[[3, 7, 8]] / K
    jacobian[10, [2, 4, 6]] = light.saturation.level_DN - dark.black_DN, -c, c
    return values, jacobian @ inner @ jacobian.T


def prnu_gain(light: LightTerms) -> float:
    """What the likelihood gains by PRNU (minus twice the logarithm)."""
    return (light.prnu.variance / max(light.prnu.sigma, 1e-300)) ** 2 if light.prnu.variance > 0 else 0.0


def prnu_penalty(light: LightTerms) -> float:
    """What BIC asks for one more parameter."""
    return float(np.log(max(light.prnu.samples, 2)))


def _prnu_candidates(light: LightTerms) -> tuple[Candidate, ...]:
    gain, penalty = prnu_gain(light), prnu_penalty(light)
    there = gain > penalty
    return (
        Candidate("without PRNU", 0, max(gain - penalty, 0.0), not there),
        Candidate("with PRNU", 1, max(penalty - gain, 0.0), there),
    )


def _response_candidates(light: LightTerms) -> tuple[Candidate, ...]:
    return tuple(
        Candidate(order.name, order.parameters, float(criterion), order == light.curve.order)
        for order, criterion in light.curve.tried
    )


def _diagnostics(data: NoiseData, dark: DarkTerms, light: LightTerms) -> tuple[Diagnostic, ...]:
    return (
        Diagnostic("photon_transfer_bins", float(light.curve.bins), "1"),
        Diagnostic("photon_transfer_levels", float(light.curve.usable_levels), "1"),
        Diagnostic("photon_transfer_up_to", light.curve.fit_up_to, "1"),
        Diagnostic("V0_DN2", float(light.transfer.values[1]), "DN^2"),
        Diagnostic("saturated_bins", float(light.saturation.bins), "1"),
        Diagnostic("curvature", float(light.transfer.values[2]), "1/DN"),
        Diagnostic("response_DN_per_light", float(light.transfer.values[3]), "DN"),
        Diagnostic("light_offset", float(light.transfer.values[4]), "light"),
        Diagnostic("light_scatter", light.transfer.scatter, "1"),
        Diagnostic("hot_pixels", float(nonuniformity.count_hot(data.dark_stack.mean_DN)), "1"),
        Diagnostic("dark_samples_outside_histogram", float(sum(p.outside for p in data.darks)), "1"),
        Diagnostic("prnu_outliers_left_out", float(light.prnu.outliers), "1"),
        Diagnostic("dark_fit_iterations", float(dark.iterations), "1"),
        Diagnostic("edge_gain", dark.edge_gain, "1"),
    )


def _outliers(data: NoiseData, dark: DarkTerms, light: LightTerms) -> tuple[Outliers, ...]:
    def named(levels: tuple[int, ...]) -> tuple[str, ...]:
        stack = len(data.flats)
        return tuple("flat stack" if i >= stack else f"flat {i} ({data.flats[i].exposure_s:.4g} s)" for i in levels)[:8]

    sigma, curve = f"{OUTLIER_SIGMA:.0f} robust sigma", light.curve
    # Among clipped samples those that are not stand out; that is no defect.
    ceiling = light.saturation.level_DN - 0.1 * light.full_DN
    hits = sum(flat.outliers for flat in data.flats if float(flat.mean_DN.max()) < ceiling) + data.dark_outliers
    found = (
        Outliers("two codes of a pixel 8 sigma apart in a pair (hits, blinking pixels)", hits),
        Outliers(
            f"flats of a pair that differ in brightness by {sigma}",
            len(curve.flickering),
            named(curve.flickering),
        ),
        Outliers(
            f"brightness off the response by {sigma}",
            len(curve.levels_left_out),
            named(curve.levels_left_out),
        ),
        Outliers(f"bins of flats off the photon transfer curve by {sigma}", curve.bins_left_out),
        _pixels("averaged dark pixels 6 robust sigma off (hot)", dark.defects),
        _pixels("averaged flat pixels 6 robust sigma off their surroundings", light.prnu),
    )
    return tuple(one for one in found if one.count)


def _pixels(rule: str, found: nonuniformity.Unevenness) -> Outliers:
    return Outliers(rule, found.outliers, tuple(f"row {row}, column {column}" for row, column in found.places))


def _residuals(data: NoiseData, light: LightTerms) -> ResidualSample:
    """Variances of bins off the photon transfer curve, evenly drawn from all levels."""
    z = light.transfer.variance_z
    rows, columns = data.flat_stack.mean_DN.shape
    places = np.tile(tiling(rows, columns, data.period).centres_px, (len(z), 1))
    used = np.flatnonzero(np.isfinite(z.ravel()))
    drawn = used[:: max(1, -(-len(used) // _MOST_RESIDUALS))]
    return ResidualSample(places[drawn], z.ravel()[drawn])


def _notes(data: NoiseData, dark: DarkTerms, light: LightTerms) -> tuple[str, ...]:
    notes = list(data.notes)
    if not light.saturation.bins:
        level = light.saturation.level_DN
        notes.append(f"No flat reached saturation; the converter's largest code, {level:.0f} DN, is taken for it.")
    if not dark.white:
        notes.append("Rounding or cut-off codes bend the dark codes; black and DSNU come from the histograms.")
    if light.curve.order.curved:
        notes.append(f"The response bends: {100 * light.nonlinearity:.2g} % of the signal is missing at full scale.")
    if light.bent_too_far:
        notes.append("The response bends more than the model can say. Check the exposures and the lamp.")
    if light.curve.fit_up_to < 0.9:
        part = f"{100 * light.curve.fit_up_to:.0f} %"
        notes.append(f"Flats above {part} of saturation do not follow the curve and are left out.")
    if light.curve.order.unsteady:
        notes.append(f"The light differs by {100 * light.transfer.scatter:.2g} % from level to level.")
    return tuple(notes)
