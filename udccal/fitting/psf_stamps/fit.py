"""Fit a psf field to stamps of point sources, with orders, places and light, and calibrated error bars."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag

from udccal.arguments import check_kind, check_optional, check_seed
from udccal.errors import FitError
from udccal.fitting.engine.gaussian import Posterior
from udccal.fitting.engine.orders import Choice
from udccal.fitting.engine.report import estimates, residual_sample
from udccal.fitting.engine.robust import OutlierRule, outliers, robust_sigma
from udccal.fitting.psf_stamps.bend import Bend, bend_of
from udccal.fitting.psf_stamps.data import Stamps, StampsRules, unusable
from udccal.fitting.psf_stamps.equations import laplace, marginal_cov
from udccal.fitting.psf_stamps.model_error import add_model_error, widen
from udccal.fitting.psf_stamps.probability import State, expectation
from udccal.fitting.psf_stamps.search import WINDOW_PX, Found, Orders, search
from udccal.fitting.psf_stamps.slope import without_slope
from udccal.fitting.psf_stamps.strengths import drawn_strengths
from udccal.fitting.psf_stamps.term import StampsPsf
from udccal.numerics import in_float64
from udccal.result import Diagnostic, FitResult, FitStatus, Outliers


@in_float64
def fit_psf_stamps(
    stamps: Stamps, orders: Orders | None = None, seed: int = 0, rules: StampsRules | None = None
) -> FitResult[StampsPsf]:
    """Fit the psf field of stamps.

    Args:
        stamps: of at least four point sources, in electrons; checked when they were made.
        orders: degrees and spacing of nodes; None to choose them by the evidence.
        seed: of the draws that represent the posterior.
        rules: see ``StampsRules``.

    Returns:
        A result whose term predicts kernels and their sigma anywhere in the field. Its estimates are the expected
        relative L2 error at the stamps' positions, and the coefficients of the map.

    Raises:
        FitError: when there are fewer than four stamps with light, or no psf describes any of them.
    """
    check_kind(stamps, Stamps, "Cut one stamp about each star, and give udccal's Stamps.", FitError)
    check_optional(orders, Orders, FitError)
    check_optional(rules, StampsRules, FitError)
    check_seed(seed, FitError)
    rules = rules or StampsRules()
    if (count := len(stamps.values_e)) < 4:
        raise FitError(f"Expected at least 4 stamps, found {count}. Cut more of them.")
    if (lit := int((stamps.value_e > stamps.read_e).any(axis=1).sum())) < 4:
        raise FitError(f"Expected light above the noise in at least 4 stamps, found it in {lit}. Check what was cut.")
    stamps, sloped = without_slope(stamps)
    bad, lowest = unusable(stamps, rules), Orders(0, 0, rules.spacings_px[0])
    # Stamps that determine nothing lead to numbers that are not finite, which the equations refuse.
    with np.errstate(all="ignore"):
        try:
            chosen = search(stamps, rules, orders if bad is None else lowest)
        except np.linalg.LinAlgError:
            note = "The equations were singular; what is given is one psf for all places."
            bad = bad or (FitStatus.NOT_CONVERGED, note)
            chosen = _one_for_all(stamps, rules, lowest)
        result = _report(stamps, chosen, seed, rules, bad)
    return replace(result, notes=(*result.notes, *sloped))


def _one_for_all(stamps: Stamps, rules: StampsRules, lowest: Orders) -> Choice[Found]:
    """The fit of the lowest orders; a FitError where there is none."""
    try:
        return search(stamps, rules, lowest)
    except np.linalg.LinAlgError:
        raise FitError(
            f"Expected stamps that a psf can describe, found {int(stamps.known.sum())} samples with a value and no "
            "solution. Check units, noise and clipping level, and that each stamp holds one point source."
        ) from None


class _Uncertainty(NamedTuple):
    """Of all unknowns: the term's ``factor``, and the covariance of the maps' coefficients."""

    factor: Float[np.ndarray, "unknowns k"]
    map_cov: Float[np.ndarray, "n n"]
    effective: float
    chi2_dof: float
    inflation: float


def _uncertainty(
    stamps: Stamps, state: State, chi2: float, samples: int, seed: int, rules: StampsRules
) -> _Uncertainty:
    posterior = laplace(stamps, state)
    draws = posterior.draws(np.random.default_rng(seed), rules.draws[1])
    # All unknowns (except total light and common shift, which are held), less the part that the priors determine.
    held = float(state.precisions @ state.squares(draws))
    unknowns = int(state.kept.sum()) * state.light_e.shape[1] + state.maps + state.maps_from
    effective = unknowns - 2 - state.light_e.shape[1] - held
    chi2_dof = chi2 / max(samples - effective, 1.0)
    inflation = float(np.sqrt(chi2_dof)) if chi2_dof > rules.inflate_above else 1.0
    # In place: of a field of ten images, each copy of the draws takes 0.1 GB.
    widen(state, draws, rules.prior_doubt)
    draws *= inflation
    add_model_error(state, draws)
    # The way that is left, and on to what the data alone prefer, is one more standard deviation: kernels with more
    # structure than the priors expect are smoothed by about as much. What is smoothed already pulls too little, so that
    # the way is taken again from its own end.
    way = np.zeros_like(state.vector)
    for _ in range(2):
        way = posterior.mode + posterior.solved(state.prior @ (state.vector + way))
    for draw, size in zip(draws.T, np.random.default_rng(3).standard_normal(rules.draws[1]), strict=True):
        draw += size * way
    draws = np.concatenate([draws, inflation * drawn_strengths(stamps, state, rules)])
    draws /= np.sqrt(rules.draws[1])
    map_cov = inflation**2 * marginal_cov(posterior.root, state.maps_from + np.arange(state.field.warp.size))
    return _Uncertainty(draws, map_cov, effective, chi2_dof, inflation)


def _report(
    stamps: Stamps, chosen: Choice[Found], seed: int, rules: StampsRules, bad: tuple[FitStatus, str] | None
) -> FitResult[StampsPsf]:
    found, state = chosen.best.fit, chosen.best.fit.place
    seen = expectation(stamps, state)
    used = seen.weight > 0
    z = (seen.residual * np.sqrt(seen.weight))[used]
    factor, map_cov, effective, chi2_dof, inflation = _uncertainty(stamps, state, float(z @ z), z.size, seed, rules)
    term = _term(stamps, state, factor)
    # The expected error, then the maps' coefficients, named by colour, element and degrees in x and y.
    size, spread = np.sqrt((term.relative_l2(term.star_px, term.field.reference) ** 2).mean(axis=0))
    cov, names = block_diag(spread**2, map_cov), ["kernel_relative_l2", *_names(state)]
    bend = bend_of(stamps, state)
    status, note = bad or _verdict(stamps, found, chi2_dof, float(size), term, rules)
    if status is FitStatus.CONVERGED and bend is not None and bend.size > size:
        status = FitStatus.POOR_FIT
    return FitResult(
        name="psf",
        term=term,
        status=status,
        estimates=estimates("psf", names, np.concatenate([[size], state.field.warp.ravel()]), cov),
        cov=cov,
        chi2_dof=chi2_dof,
        samples=z.size,
        candidates=chosen.candidates,
        diagnostics=(
            Diagnostic("iterations", float(found.iterations), "1"),
            Diagnostic("effective_parameters", effective, "1"),
            Diagnostic("clipped_samples", float(stamps.clipped.sum()), "1"),
            Diagnostic("samples_beyond_the_image", float((stamps.known & state.keep).sum() - z.size), "1"),
            Diagnostic("sigma_inflation", inflation, "1"),
            Diagnostic("model_error", state.misfit, "1"),
            Diagnostic("left_out_off", state.left_out_off, "1"),
            Diagnostic("background", float(state.background_e.mean()), "e-"),
        ),
        notes=(
            *([note] if note else []),
            *_told(state),
            *_bent(bend),
            *_quiet(stamps, state, z.size - effective, rules),
        ),
        outliers=_left_out(stamps, state, rules),
        residuals=residual_sample((term.star_px[:, None] + stamps.offset_px)[used], z),
        posterior=Posterior(np.zeros(len(term.factor)), term.factor, term.changed),
    )


def _verdict(
    stamps: Stamps, found: Found, chi2_dof: float, size: float, term: StampsPsf, rules: StampsRules
) -> tuple[FitStatus, str]:
    """Return the status, and what to do where it is a bad one; ``size`` is the expected relative error of kernels."""
    off = found.place.left_out_off
    left_out = f"Stamps that were left out are off by {100 * off:.2g} %, where {100 * size:.2g} % are expected."
    if max(chi2_dof, _faint_scatter(stamps, found.place)) > rules.poor_above:
        return FitStatus.POOR_FIT, "Check the noise given, and that each stamp holds one point source."
    if off**2 > rules.poor_above * size**2:
        return FitStatus.POOR_FIT, f"{left_out} Check that each stamp has its own position."
    if not found.converged and len(found.place.field.mix) >= rules.most_images:
        told = f"{rules.most_images} images did not describe the stamps, and error bars do not hold."
        return FitStatus.POOR_FIT, f"{told} Check that each stamp holds one star; leave out those that are crowded."
    if size > rules.poor_error:
        told = f"Kernels are expected to be off by {100 * size:.2g} %."
        return FitStatus.POOR_FIT, f"{told} Give more or brighter stamps, large enough for the whole psf."
    # Where positions are not the stars' own, those left out are as far off as if there were one psf for all.
    if off > size and off > rules.least_predicted * _spread(term):
        return FitStatus.POOR_FIT, f"{left_out} Check that each stamp has its own position."
    if not found.converged:
        left = f"It was left after {found.iterations} steps; give lower orders, or leave out stamps that differ."
        return FitStatus.NOT_CONVERGED, left
    return FitStatus.CONVERGED, ""


def _spread(term: StampsPsf) -> float:
    """Return by how much kernels at the stars differ from their mean, relative L2, root mean square."""
    kernels = term.predict(term.star_px, term.field.reference)
    mean = kernels.mean(axis=0)
    return float(np.sqrt(((kernels - mean) ** 2).sum(axis=(1, 2)).mean() / (mean**2).sum()))


def _faint_scatter(stamps: Stamps, state: State) -> float:
    """Return the mean square, by the median, of residuals where light is faint: errors of the psf hardly show there."""
    plain = expectation(stamps, state.without_error())
    used = (plain.weight > 0) & (plain.mean_e <= np.quantile(plain.mean_e, 0.25))
    return robust_sigma((plain.residual * np.sqrt(plain.weight))[used]) ** 2


def _term(stamps: Stamps, state: State, factor: np.ndarray) -> StampsPsf:
    stars = stamps.position_px.astype(np.float64), state.centre_px, state.light_e
    (centre, half), (_, rows, columns) = stamps.frame_px, stamps.values_e.shape
    term = StampsPsf(state.field, factor, centre, half, rows, columns, WINDOW_PX, *stars)
    return term.with_own_window()


def _told(state: State) -> tuple[str, ...]:
    """Return notes on what was found outside the model, and is part of it now."""
    notes, mean = [], state.background_e.mean(axis=0)
    if state.lit:
        found = ", ".join(f"{level:.3g}" for level in mean)
        told = "It was fitted stamp by stamp; subtract it beforehand to know the psf's edge better."
        notes.append(f"The stamps have a background of {found} e- that is not zero. {told}")
    if error := state.misfit:
        told = "Error bars include it: the field changes more than its orders follow, or the noise given is wrong."
        notes.append(f"The psf differs from the model by {100 * error:.2g} %. {told}")
    return tuple(notes)


def _bent(bend: Bend | None) -> tuple[str, ...]:
    """Return a note where peaks of bright stars are not those of faint ones."""
    if bend is None:
        return ()
    how, off = "lower" if bend.missing > 0 else "higher", 100 * abs(bend.missing)
    found = f"The brightest peak is {off:.2g} % {how} than fainter stars predict: the response bends"
    wrong = f"and kernels may be {100 * bend.size:.2g} % wrong"
    return (f"{found}, {wrong}. Give light that is linear: the noise term's nonlinearity tells how.",)


def _quiet(stamps: Stamps, state: State, dof: float, rules: StampsRules) -> tuple[str, ...]:
    """Return a note where samples scatter less than the noise given, the psf's own error apart."""
    plain = expectation(stamps, state.without_error())
    chi2_dof = float((plain.residual**2 * plain.weight).sum()) / max(dof, 1.0)
    if chi2_dof > 1 - max(rules.noise_off, 6 * np.sqrt(2 / max(dof, 1.0))):
        return ()
    told = f"Samples scatter with {chi2_dof:.2g} times the variance of the noise given: error bars are too wide."
    return (f"{told} Check the read noise, and that values are electrons, less the black level.",)


def _names(state: State) -> list[str]:
    powers = [(i, d - i) for d in range(1, state.field.map_degree + 1) for i in range(d, -1, -1)]
    prefixes = ["map_r", "map_g", "map_b"][: len(state.field.warp)] if len(state.field.warp) > 1 else ["map"]
    return [f"{p}_{e}_{i}{j}" for p in prefixes for i, j in powers for e in ("xx", "xy", "yx", "yy")]


def _left_out(stamps: Stamps, state: State, rules: StampsRules) -> tuple[Outliers, ...]:
    stars = np.asarray(state.keep.any(axis=1))
    left = np.argwhere(stamps.known & ~state.keep & stars[:, None])
    samples = ((star, *stamps.offset_px[sample]) for star, sample in left)
    places = (f"stamp {star}, {x:+.0f} px, {y:+.0f} px from its middle" for star, x, y in samples)
    rule = (
        f"stamps whose mean square is over {rules.star_ratio:g} times the median's, or that lose "
        f"{100 * rules.star_lost:.0f} % of their samples"
    )
    named = OutlierRule("samples", rules.outlier_sigma).listed(places)
    return named + outliers(rule, (f"stamp {star}" for star in np.flatnonzero(~stars)))
