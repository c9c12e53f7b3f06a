"""Fit a psf field to stamps of point sources: orders, places and light found along with it, and true error bars.

The data are arrays: stamps in electrons, each about one source, of a sensor without colours or of a raw mosaic.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag

from udccal.errors import FitError
from udccal.fitting.engine.gaussian import Posterior
from udccal.fitting.engine.orders import Choice
from udccal.fitting.engine.report import estimates, residual_sample
from udccal.fitting.engine.robust import OutlierRule, outliers
from udccal.fitting.psf_stamps.data import Stamps, StampsRules
from udccal.fitting.psf_stamps.equations import factors, marginal_cov
from udccal.fitting.psf_stamps.probability import State, expectation
from udccal.fitting.psf_stamps.search import WINDOW_PX, Found, Orders, search
from udccal.fitting.psf_stamps.term import StampsPsf
from udccal.numerics import in_float64
from udccal.result import Diagnostic, FitResult, FitStatus, Outliers


@in_float64
def fit_psf_stamps(
    stamps: Stamps, orders: Orders | None = None, seed: int = 0, rules: StampsRules | None = None
) -> FitResult[StampsPsf]:
    """The psf field of stamps.

    Args:
        stamps: of at least four point sources; checked when they were made.
        orders: degrees and spacing of nodes; found by the data when left out.
        seed: of the draws that stand for the posterior.
        rules: see ``StampsRules``.

    Returns:
        A result whose term predicts kernels and their sigma anywhere in the field. Its estimates are the relative L2
        error to be expected at the stamps' positions, and the coefficients of the map.

    Raises:
        FitError: when there are fewer than four stamps.
    """
    rules = rules or StampsRules()
    if stamps.count < 4:
        raise FitError(f"Expected at least 4 stamps, found {stamps.count}. Cut more of them.")
    bad, lowest = _unusable(stamps, rules), Orders(0, 0, rules.spacings_px[0])
    try:
        chosen = search(stamps, rules, orders if bad is None else lowest)
    except np.linalg.LinAlgError:
        bad = FitStatus.NOT_CONVERGED, "The equations were singular; what is given is one psf for all places."
        chosen = search(stamps, rules, lowest)
    return _report(stamps, chosen, np.random.default_rng(seed), rules, bad)


def _unusable(stamps: Stamps, rules: StampsRules) -> tuple[FitStatus, str] | None:
    """What stands in the way of a fit, if anything."""
    core = stamps.by_plane & (np.abs(stamps.offset_px).max(axis=1) <= 1.5)
    for own, near in zip(stamps.by_plane, core, strict=True):
        light = (stamps.value_e * own).sum(axis=1)
        noise = np.sqrt(np.maximum(light, 0.0) + own.sum(axis=1) * stamps.read_e**2)
        snr = float(np.median(light / np.maximum(noise, 1e-300)))
        if snr < rules.least_snr:
            needed = f"at least {rules.least_snr:.0f} are needed."
            return FitStatus.TOO_DARK, f"Light over noise of a stamp is {snr:.1f} in the median; {needed}"
        clear = int((near.any(axis=1) & ~(near & stamps.clipped).any(axis=1)).sum())
        if clear < rules.fewest_unclipped:
            needed = f"{rules.fewest_unclipped} are needed."
            return FitStatus.SATURATED, f"{clear} stamps have a core that is not clipped or missing; {needed}"
    return None


def _report(
    stamps: Stamps,
    chosen: Choice[Found],
    rng: np.random.Generator,
    rules: StampsRules,
    bad: tuple[FitStatus, str] | None,
) -> FitResult[StampsPsf]:
    found, state = chosen.best.fit, chosen.best.fit.place
    posterior, seen = factors(stamps, state), expectation(stamps, state)
    draws, used = posterior.draws(rng, rules.draws[1]), seen.weight > 0
    z = (seen.residual * np.sqrt(seen.weight))[used]
    # All unknowns (but all light and all places together, which are held), less what the priors say of them.
    held = float(state.precisions @ state.squares(draws))
    effective = state.field.numbers + state.maps_from - 2 - state.light_e.shape[1] - held
    chi2_dof = float(z @ z) / max(z.size - effective, 1.0)
    inflation = float(np.sqrt(chi2_dof)) if chi2_dof > rules.inflate_above else 1.0
    term = _term(stamps, state, draws * (inflation / np.sqrt(rules.draws[1])))
    # The error to be expected, then the maps' coefficients, named by colour, element and degrees in x and y.
    size, spread = np.sqrt((term.relative_l2(term.star_px, term.field.reference) ** 2).mean(axis=0))
    warp = state.field.warp
    cov = inflation**2 * marginal_cov(posterior.root, state.maps_from + np.arange(warp.size))
    cov, names = block_diag(spread**2, cov), ["kernel_relative_l2", *_names(state)]
    status, note = bad or _verdict(found, chi2_dof, rules)
    diagnostics = (
        Diagnostic("iterations", float(found.iterations), "1"),
        Diagnostic("effective_parameters", effective, "1"),
        Diagnostic("log_evidence", found.equations.evidence, "1"),
        Diagnostic("clipped_samples", float(stamps.clipped.sum()), "1"),
        Diagnostic("samples_beyond_the_image", float((stamps.known & state.keep).sum() - z.size), "1"),
        Diagnostic("centroid_window", term.window_px, "px"),
        Diagnostic("sigma_inflation", inflation, "1"),
    )
    return FitResult(
        name="psf",
        term=term,
        status=status,
        estimates=estimates(names, ["1"] * len(names), np.concatenate([[size], warp.ravel()]), cov),
        cov=cov,
        chi2_dof=chi2_dof,
        samples=z.size,
        candidates=chosen.candidates,
        diagnostics=diagnostics,
        notes=(note,) if note else (),
        outliers=_left_out(stamps, state, rules),
        residuals=residual_sample((term.star_px[:, None] + stamps.offset_px)[used], z),
        posterior=Posterior(np.zeros(len(term.factor)), term.factor, term.changed),
    )


def _term(stamps: Stamps, state: State, factor: np.ndarray) -> StampsPsf:
    centre, half = stamps.frame_px
    star_px = stamps.position_px.astype(np.float64)
    stars = star_px, state.centre_px, state.light_e
    term = StampsPsf(state.field, factor, centre, half, *stamps.grid, WINDOW_PX, *stars)
    # A Gaussian as wide as the kernel, by its noise-equivalent area of 4 pi sigma^2.
    kernel = term.predict(centre[None], state.field.reference)
    return replace(term, window_px=float(1 / np.sqrt(4 * np.pi * (kernel**2).sum())))


def _verdict(found: Found, chi2_dof: float, rules: StampsRules) -> tuple[FitStatus, str]:
    if chi2_dof > rules.poor_above:
        return FitStatus.POOR_FIT, "Check the noise given, and that each stamp holds one point source."
    if not found.converged:
        return FitStatus.NOT_CONVERGED, f"It was left after {found.iterations} steps; use more or brighter stamps."
    return FitStatus.CONVERGED, ""


def _names(state: State) -> list[str]:
    planes = len(state.field.warp)
    powers = [(i, d - i) for d in range(1, state.field.degrees[0] + 1) for i in range(d, -1, -1)]
    prefixes = [f"map_{'rgb'[plane]}" for plane in range(planes)] if planes > 1 else ["map"]
    return [f"{p}_{e}_{i}{j}" for p in prefixes for i, j in powers for e in ("xx", "xy", "yx", "yy")]


def _left_out(stamps: Stamps, state: State, rules: StampsRules) -> tuple[Outliers, ...]:
    """What the state leaves out: the rules, how many, and the first places."""
    places = []
    for star, sample in np.argwhere(stamps.known & ~state.keep & ~state.out[:, None]):
        x, y = stamps.offset_px[sample]
        places.append(f"stamp {star}, {x:+.0f} px, {y:+.0f} px from its middle")
    rule = (
        f"stamps whose mean square is over {rules.star_ratio:g} times the median's, or that lose "
        f"{100 * rules.star_lost:.0f} % of their samples"
    )
    named = OutlierRule("samples", rules.outlier_sigma).listed(places)
    return named + outliers(rule, (f"stamp {star}" for star in np.flatnonzero(state.out)))
