"""Backscatter fit: from averages of the panel's pictures under blackout to the panel's light on the sensor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from udccal.fitting.absent import absent_backscatter
from udccal.fitting.backscatter.data import BackscatterData, grid_rays
from udccal.fitting.backscatter.model import Usable, window_for
from udccal.fitting.backscatter.orders import BAD_BINS, BAD_PICTURES, Found, search, value_moments
from udccal.fitting.backscatter.parameters import (
    DEPTH,
    DISTANCE,
    NAMES,
    OFFSET,
    PUPIL,
    UNITS,
    BackscatterRules,
    Moments,
    footprint_per_pupil,
    linear_of,
    linear_slope,
)
from udccal.fitting.backscatter.solve import Problem, TermAt
from udccal.fitting.engine.gaussian import Posterior
from udccal.fitting.engine.misfit import MisfitTest, group_means_test, sharper
from udccal.fitting.engine.report import estimates, residual_sample
from udccal.fitting.engine.robust import outliers
from udccal.models.backscatter import Backscatter
from udccal.models.geometry import Geometry
from udccal.numerics import in_float64
from udccal.result import Diagnostic, FitResult, FitStatus, Outliers
from udccal.rig import RigDescription


def fit_backscatter(
    data: BackscatterData, geometry: Geometry, rig: RigDescription, rules: BackscatterRules | None = None
) -> FitResult[Backscatter]:
    """Fit the backscatter term to binned rates.

    The term has the most probable parameters. Estimates are posterior means, whose errors are to either side as often
    as sigma says. The two differ where a parameter is known only to some tens of per cent.

    Args:
        data: rates in e-/s of white, dark and at least 6 other pictures (``read_backscatter``).
        geometry: the rays of pixels.
        rig: gives the start and its tolerances, which are the prior.
        rules: see ``BackscatterRules``.

    Returns:
        The term, its estimates in the units of their names, and its posterior. Data that cannot be fitted give a status
        and a note instead of an exception.
    """
    rules = rules or BackscatterRules()
    keep = data.shots.clipped.mean(axis=(1, 2, 3))[1:-1] <= rules.most_clipped
    status, note = _usable(data, keep, rules)
    if status is not FitStatus.CONVERGED:
        return FitResult.failed("backscatter", absent_backscatter(rig, geometry), status, note)
    clipped = [name for name, kept in zip(data.names, keep, strict=True) if not kept]
    used = data.only(keep)
    return result_of(search(Problem.of(used, geometry, rig, rules)), used, rig, clipped)


def _usable(
    data: BackscatterData, keep: Bool[np.ndarray, " pictures"], rules: BackscatterRules
) -> tuple[FitStatus, str]:
    """Return whether a fit can start with white, dark and the pictures to keep, and a note if it cannot."""
    shots = data.shots
    if len(shots.rate) < 2:
        note = "Expected the steps backscatter/white and backscatter/dark, found that they were not captured."
        return FitStatus.TOO_FEW_DATA, note
    if (clipped := shots.clipped[0].mean()) > rules.most_clipped:
        return FitStatus.SATURATED, f"{clipped:.0%} of the white picture's bins hold clipped samples."
    sigma = shots.excess[0] / np.sqrt(shots.variance(np.zeros(shots.rate.shape))[0] + shots.rest[-1])
    present = float(sigma.sum()) > rules.present_sigma * np.sqrt(sigma.size)
    if not (present and float(np.percentile(sigma, 90)) > rules.visible_sigma):
        return FitStatus.ABSENT, "The white picture gives no light that shows above noise."
    found = f"found {keep.sum()} ({(~keep).sum()} clipped)"
    if keep.sum() < rules.fewest_pictures:
        return FitStatus.TOO_FEW_DATA, f"Expected at least {rules.fewest_pictures} unclipped pictures, {found}."
    return FitStatus.CONVERGED, ""


def result_of(found: Found, data: BackscatterData, rig: RigDescription, clipped: list[str]) -> FitResult[Backscatter]:
    """Return the fit as a result; ``clipped`` names the pictures that were left out before it."""
    fitted, template, used = found.fitted, found.problem.template, found.fitted.used
    rest = residual_pattern(found)
    values = value_moments(found, rest.inflation)
    # Change of lengths with one sigma of the pitch: pictures give lengths in panel pixels only.
    moved, lengths = np.zeros(len(NAMES)), [DISTANCE, PUPIL, DEPTH]
    moved[lengths] = values.mean[lengths] * rig.panel.pitch_mm.tolerance / rig.panel.pitch_mm.value
    scale = np.ones(len(NAMES))
    scale[PUPIL] = 1 / footprint_per_pupil(rig)
    cov = (values.cov + np.outer(moved, moved)) * np.outer(scale, scale)
    shape = data.shots.rate.shape[2:]
    rays = grid_rays(template.geometry, shape, template.step, np.arange(shape[0] * shape[1]))
    window = window_for(template, linear_of(fitted.found.x), rays, slack=0.5)
    posterior = term_posterior(replace(template, window=window), data, found, rest.inflation)
    status, advice = _status(found)
    # Variance between the frames of a shot over the noise model's, as the median of all shots; 0: unknown.
    known = data.shots.scatter[:-1][np.isfinite(data.shots.scatter[:-1])]
    scatter = float(np.median(known)) if known.size else 0.0
    # The eliminated mask reduces the residuals' variance; this corrects for it.
    z = fitted.z[used] * np.sqrt(used.sum() / found.dof)
    return FitResult(
        name="backscatter",
        term=posterior.term_at(posterior.mean),
        status=status,
        estimates=estimates(NAMES, UNITS, values.mean * scale, cov),
        cov=cov,
        chi2_dof=fitted.best.chi2 / found.dof,
        samples=int(used.sum()),
        candidates=found.orders.candidates,
        diagnostics=(
            Diagnostic("held_out_without_noise_of_peak", found.held_out, "1"),
            Diagnostic("model_error_of_white", found.model_error, "1"),
            Diagnostic("pattern_p_value", rest.p_value, "1"),
            Diagnostic("pattern_inflation", rest.inflation, "1"),
            Diagnostic("frame_scatter_over_noise", scatter, "1"),
            Diagnostic("pictures", float((~found.bad_shots[1:-1]).sum()), "1"),
        ),
        notes=(*advice, *_notes(found, rest, scatter, clipped)),
        outliers=_outliers(found, data, clipped),
        residuals=residual_sample(_places(found)[np.nonzero(used)[2]] * template.step, z),
        posterior=posterior,
    )


def residual_pattern(found: Found) -> MisfitTest:
    """Test whether residuals of a shot and colour have the same sign over parts of the sensor or all of it."""
    fitted, cells, places, used = found.fitted, found.problem.rules.cells, _places(found), found.fitted.used
    low, high = places.min(axis=0), places.max(axis=0)
    column, row = np.minimum((places - low) / np.maximum(high - low, 1e-9) * cells, cells - 1).astype(int).T
    groups = np.arange(used[..., 0].size).reshape(*used.shape[:2], 1)
    scale = max(fitted.best.chi2 / found.dof, 1.0) * found.dof / max(used.sum(), 1)
    tests = [
        group_means_test(fitted.z.ravel(), (groups * cells**2 + cell).ravel(), used.ravel(), scale)
        for cell in (row * cells + column, np.zeros(len(places), dtype=int))
    ]
    return sharper(*tests)


def _places(found: Found) -> Float[np.ndarray, "n 2"]:
    """Return grid columns and rows of the positions."""
    template = found.problem.template
    rows, columns = np.divmod(found.problem.flat, template.columns // template.step)
    return np.stack([columns, rows], axis=1).astype(np.float64)


def _status(found: Found) -> tuple[FitStatus, tuple[str, ...]]:
    """Return the fit's status, and notes on what to do in addition to the status's own advice."""
    solved, problem, rules = found.fitted.found, found.problem, found.problem.rules
    if not solved.converged:
        return FitStatus.NOT_CONVERGED, ("Check panel and mounting in the rig's description.",)
    if window_for(problem.template, linear_of(solved.x), problem.rays, slack=0.0) > problem.template.window:
        return FitStatus.POOR_FIT, (
            "The pictures ask for footprints on the panel of more than three times their nominal width. Check lens, "
            "stand-off and pitch in the description, and that every frame was stored with the picture that was shown.",
        )
    place = np.array([DISTANCE, PUPIL, OFFSET.start, OFFSET.start + 1])
    sigma = np.sqrt(np.maximum(np.diag(solved.cov), 0.0))[place]
    unsure = (sigma > rules.undetermined * problem.prior.sigma[place]) & (sigma > np.array(rules.known))
    if unsure.any():
        return FitStatus.TOO_FEW_DATA, (
            f"The pictures do not determine {', '.join(NAMES[k] for k in place[unsure])}. Show pictures that differ in "
            "brightness, colour and shapes, or expose longer.",
        )
    if found.held_out > rules.worst_error:
        return FitStatus.POOR_FIT, (
            f"Pictures held out of the fit are predicted {found.held_out:.0%} of their peak wrong, "
            "noise apart. Check that every frame was stored with the picture that the panel showed.",
        )
    bad = found.bad_shots[:-1]
    if bad.mean() > rules.most_outliers:
        return FitStatus.POOR_FIT, (
            f"{bad.sum()} of {bad.size} pictures do not fit the others. Capture again, with exposures of whole periods "
            "of the panel's refresh.",
        )
    return FitStatus.CONVERGED, ()


def _notes(found: Found, rest: MisfitTest, scatter: float, clipped: list[str]) -> tuple[str, ...]:
    notes = [f"{len(clipped)} clipped pictures left out."] if clipped else []
    if found.model_error > 0:
        notes.append(f"Ratios to white are modelled to {found.model_error:.2%} only; that counts as noise.")
    if rest.inflation > 1:
        notes.append(
            f"Residuals have a pattern (p = {rest.p_value:.1g}); all sigmas are {np.sqrt(rest.inflation):.1f} times "
            "those of independent ones."
        )
    if scatter > found.problem.rules.steady:
        notes.append(
            f"Frames of one picture vary {scatter:.1f} times as much as noise: the panel may flicker. Expose "
            "for whole periods of its refresh."
        )
    held = [name for name, free in zip(NAMES, found.fitted.order.free, strict=True) if not free]
    if held:
        notes.append(f"Held: {', '.join(held)}.")
    return (*notes, "Estimates start from the rig's values with its tolerances as prior sigma.")


def _outliers(found: Found, data: BackscatterData, clipped: list[str]) -> tuple[Outliers, ...]:
    """Return the samples and pictures that were left out, by rule."""
    names, usable, bad = ("white", *data.names), found.problem.seen.usable[:-1], found.bad_shots[:-1]
    places = _places(found).astype(int)

    def named(which: Usable) -> list[str]:
        return [f"{names[i]} {'RGB'[c]} bin ({places[n, 0]}, {places[n, 1]})" for i, c, n in np.argwhere(which)]

    return (
        *outliers(f"pictures with more than {found.problem.rules.most_clipped:.0%} of their bins clipped", clipped),
        *BAD_PICTURES.listed(name for name, one in zip(names, bad, strict=True) if one),
        *outliers("bins with clipped samples", named(~usable)),
        *BAD_BINS.listed(named(usable & ~found.usable[:-1] & ~bad[:, None, None])),
    )


@in_float64
def term_posterior(
    template: Backscatter, data: BackscatterData, found: Found, inflation: float
) -> Posterior[Backscatter]:
    """Return the whole term's posterior: its parameters, the mask that follows them, its noise, and other orders.

    The model error of a picture (``model_error_of_white``) is not an error of the term and adds to it.

    Args:
        template: gives the window.
        data: all shots.
        found: the chosen order's fit, and the others.
        inflation: factor of the parameters' variance.
    """
    theta, orders, parts = linear_of(found.fitted.found.x), found.orders, []
    for one in orders.tried:
        fit, factor = (found.fitted.found, inflation) if one is orders.best else (one.fit.found, 1.0)
        slope = linear_slope(fit.x)
        parts.append(Moments(linear_of(fit.x), factor * fit.cov * np.outer(slope, slope)))
    cov = Moments.mixture(parts, orders.probabilities, theta).cov
    return TermAt(template, data, ~found.bad_shots, found.model_error, theta).posterior(cov)
