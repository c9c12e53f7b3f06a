"""Fit a psf field to stamps of point sources: orders, places and light found along with it, and true error bars.

The data are arrays: stamps in electrons, each about one source, of a sensor without colours or of a raw mosaic.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag

from udccal.errors import FitError
from udccal.fitting.engine.gaussian import Posterior
from udccal.fitting.engine.orders import Choice
from udccal.fitting.engine.report import estimates, residual_sample
from udccal.fitting.psf_stamps.data import Scene, Stamps, StampsRules, split
from udccal.fitting.psf_stamps.equations import MapCoefficients, factors, marginal_cov
from udccal.fitting.psf_stamps.orders import Found, Orders, reference, search
from udccal.fitting.psf_stamps.probability import State, Weighted, expectation
from udccal.fitting.psf_stamps.solve import left_out
from udccal.fitting.psf_stamps.term import StampsPsf
from udccal.numerics import in_float64
from udccal.result import Diagnostic, Estimate, FitResult, FitStatus, ResidualSample

_WINDOW_PX = 1.5  # of centroids, before the kernel's size is known


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
    if len(stamps.values_e) < rules.fewest_stars:
        raise FitError(
            f"Expected at least {rules.fewest_stars} stamps, found {len(stamps.values_e)}. Cut more of them."
        )
    low, high = stamps.position_px.min(axis=0), stamps.position_px.max(axis=0)
    middle, half = (low + high) / 2.0, np.maximum((high - low) / 2.0, 1.0)
    _, *shape = stamps.values_e.shape
    unit = (stamps.position_px - middle) / half
    scene = Scene(split(stamps), unit, (shape[0], shape[1]), stamps.read_e, stamps.clip_e)
    bad, lowest = _unusable(scene, rules), Orders(0, 0, rules.spacings_px[0])
    try:
        chosen = search(scene, rules, orders if bad is None else lowest)
    except np.linalg.LinAlgError:
        bad = FitStatus.NOT_CONVERGED, "The equations were singular; what is given is one psf for all places."
        chosen = search(scene, rules, lowest)
    state = chosen.best.fit.place
    term = StampsPsf(
        fields=state.fields,
        factor=np.zeros((0, 0)),
        centre_px=middle,
        half_px=half,
        rows=shape[0],
        columns=shape[1],
        window_px=_WINDOW_PX,
        reference=reference(len(scene.planes)),
        star_px=stamps.position_px.astype(np.float64),
        star_place_px=state.centre_px,
        star_light_e=state.flux_e,
    )
    return _report(scene, chosen, term, np.random.default_rng(seed), rules, bad)


def _unusable(scene: Scene, rules: StampsRules) -> tuple[FitStatus, str] | None:
    """What stands in the way of a fit, if anything."""
    for plane in scene.planes:
        light = (plane.value_e * plane.usable).sum(axis=1)
        noise = np.sqrt(np.maximum(light, 0.0) + plane.usable.sum(axis=1) * scene.read_e**2)
        snr = float(np.median(light / np.maximum(noise, 1e-300)))
        if snr < rules.least_snr:
            needed = f"at least {rules.least_snr:.0f} are needed."
            return FitStatus.TOO_DARK, f"Light over noise of a stamp is {snr:.1f} in the median; {needed}"
        core = np.abs(plane.offset_px).max(axis=2) <= rules.core_px
        clear = int((~(plane.clipped & core).any(axis=1) & (plane.usable & core).any(axis=1)).sum())
        if clear < rules.fewest_unclipped:
            needed = f"{rules.fewest_unclipped} are needed."
            return FitStatus.SATURATED, f"{clear} stamps have a core that is not clipped or missing; {needed}"
    return None


def _report(
    scene: Scene,
    chosen: Choice[Found],
    term: StampsPsf,
    rng: np.random.Generator,
    rules: StampsRules,
    bad: tuple[FitStatus, str] | None,
) -> FitResult[StampsPsf]:
    found, state = chosen.best.fit, chosen.best.fit.place
    posterior = factors(scene, state)
    draws = posterior.draws(rng, rules.draws)
    seen = [expectation(scene, state, plane)[0] for plane in range(len(scene.planes))]
    samples = int(sum((own.weight > 0).sum() for own in seen))
    # All unknowns (but all light and all places together, which are held), less what the priors say of them.
    held = float(np.concatenate([own.flat for own in state.precisions]) @ state.squares(draws))
    effective = state.numbers + state.maps_from - 2 - len(scene.planes) - held
    chi2_dof = float(sum((own.weight * own.residual**2).sum() for own in seen)) / max(samples - effective, 1.0)
    inflation = float(np.sqrt(chi2_dof)) if chi2_dof > rules.inflate_above else 1.0
    # A Gaussian as wide as the kernel, by its noise-equivalent area of 4 pi sigma^2.
    kernel = term.predict(term.centre_px[None], term.reference)
    window_px = float(1 / np.sqrt(4 * np.pi * (kernel**2).sum()))
    term = replace(term, factor=draws * (inflation / np.sqrt(rules.draws)), window_px=window_px)
    maps = MapCoefficients.above(state, 0)
    named, cov = _estimates(state, term, maps, inflation**2 * marginal_cov(posterior.root, maps.index))
    status, note = bad or _verdict(found, chi2_dof, rules)
    clipped = sum(int(plane.clipped.sum()) for plane in scene.planes)
    used = sum(int((plane.usable & keep).sum()) for plane, keep in zip(scene.planes, state.keep, strict=True))
    return FitResult(
        name="psf",
        term=term,
        status=status,
        estimates=named,
        cov=cov,
        chi2_dof=chi2_dof,
        samples=samples,
        candidates=chosen.candidates,
        diagnostics=(
            Diagnostic("iterations", float(found.iterations), "1"),
            Diagnostic("effective_parameters", effective, "1"),
            Diagnostic("log_evidence", found.equations.evidence, "1"),
            Diagnostic("clipped_samples", float(clipped), "1"),
            Diagnostic("samples_beyond_the_image", float(used - samples), "1"),
            Diagnostic("centroid_window", window_px, "px"),
            Diagnostic("sigma_inflation", inflation, "1"),
        ),
        notes=(note,) if note else (),
        outliers=left_out(scene, state, rules),
        residuals=_residuals(scene, term, seen),
        posterior=Posterior(np.zeros(len(term.factor)), term.factor, term.changed),
    )


def _verdict(found: Found, chi2_dof: float, rules: StampsRules) -> tuple[FitStatus, str]:
    if chi2_dof > rules.poor_above:
        return FitStatus.POOR_FIT, "Check the noise given, and that each stamp holds one point source."
    if not found.converged:
        return FitStatus.NOT_CONVERGED, f"It was left after {found.iterations} steps; use more or brighter stamps."
    return FitStatus.CONVERGED, ""


def _estimates(
    state: State, term: StampsPsf, maps: MapCoefficients, cov: Float[np.ndarray, "n n"]
) -> tuple[tuple[Estimate, ...], Float[np.ndarray, "m m"]]:
    """The error to be expected, then the maps' coefficients, named by colour, element and degrees in x and y."""
    error = term.relative_l2(term.star_px, term.reference)
    size, spread = np.sqrt((error**2).mean(axis=0))
    names = ["kernel_relative_l2"]
    for plane, field in enumerate(state.fields):
        powers = [(i, d - i) for d in range(1, field.warp_degree + 1) for i in range(d, -1, -1)]
        prefix = "map" if len(state.fields) == 1 else f"map_{'rgb'[plane]}"
        names += [f"{prefix}_{e}_{i}{j}" for i, j in powers for e in ("xx", "xy", "yx", "yy")]
    whole = block_diag(spread**2, cov)
    return estimates(names, ["1"] * len(names), np.concatenate([[size], maps.value]), whole), whole


def _residuals(scene: Scene, term: StampsPsf, seen: list[Weighted]) -> ResidualSample:
    used = [own.weight > 0 for own in seen]
    places = [(term.star_px[:, None] + plane.offset_px)[u] for plane, u in zip(scene.planes, used, strict=True)]
    z = [(own.residual * np.sqrt(own.weight))[u] for own, u in zip(seen, used, strict=True)]
    return residual_sample(np.concatenate(places), np.concatenate(z))
