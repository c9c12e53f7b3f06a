"""Backscatter fit: averages of the panel's pictures under blackout -> how the panel's light gets into the lens."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from udccal.fitting.absent import absent_backscatter
from udccal.fitting.backscatter.data import BackscatterData, grid_rays
from udccal.fitting.backscatter.likelihood import LEAST_VARIANCE
from udccal.fitting.backscatter.orders import BAD_BINS, BAD_PICTURES, Found, search
from udccal.fitting.backscatter.parameters import (
    DISTANCE,
    NAMES,
    OFFSET,
    PUPIL,
    UNITS,
    footprint_share,
    linear_of,
    pitch_error,
)
from udccal.fitting.backscatter.posterior import term_posterior, value_moments
from udccal.fitting.backscatter.ratios import window_for
from udccal.fitting.backscatter.rules import BackscatterRules
from udccal.fitting.backscatter.solve import Problem
from udccal.fitting.engine.misfit import MisfitTest, group_means_test, sharper
from udccal.fitting.engine.report import estimates, residual_sample
from udccal.fitting.engine.robust import outliers
from udccal.models.backscatter import Backscatter
from udccal.models.geometry import Geometry
from udccal.result import Diagnostic, FitResult, FitStatus, Outliers
from udccal.rig import RigDescription

# Where footprints lie.
_PLACE = np.array([DISTANCE, PUPIL, OFFSET.start, OFFSET.start + 1])


def fit_backscatter(
    data: BackscatterData, geometry: Geometry, rig: RigDescription, rules: BackscatterRules | None = None
) -> FitResult[Backscatter]:
    """Fit the backscatter term to binned rates.

    The term has the most probable parameters. Estimates are means over what is possible, so that their errors are as
    often to either side as sigma says; the two differ where a parameter is known to some tens of per cent only.

    Args:
        data: white, dark and at least 6 other pictures (``read_backscatter``).
        geometry: where rays go.
        rig: gives the start and its tolerances, which are the prior.
        rules: see ``BackscatterRules``.

    Returns:
        the term, its estimates in the units of their names, and how sure it is; the status says what to do next.
    """
    rules = rules or BackscatterRules()
    keep, status, note = _usable_pictures(data, rules)
    if status is not FitStatus.CONVERGED:
        return FitResult.failed("backscatter", absent_backscatter(rig, geometry), status, note)
    clipped = [name for name, kept in zip(data.names, keep, strict=True) if not kept]
    used = data.only(keep)
    return result_of(search(Problem.of(used, geometry, rig, rules)), used, rig, clipped)


def _usable_pictures(
    data: BackscatterData, rules: BackscatterRules
) -> tuple[Bool[np.ndarray, " pictures"], FitStatus, str]:
    """Which pictures are not clipped; where they are no use, the status and why."""
    clipped = data.shots.clipped.mean(axis=(1, 2, 3))
    keep = clipped[1:-1] <= rules.most_clipped
    if len(clipped) < 2:
        note = "Expected the steps backscatter/white and backscatter/dark, found that they were not captured."
        return keep, FitStatus.TOO_FEW_DATA, note
    if clipped[0] > rules.most_clipped:
        return keep, FitStatus.SATURATED, f"{clipped[0]:.0%} of the white picture's bins hold clipped samples."
    if not _shows_light(data, rules):
        return keep, FitStatus.ABSENT, "The white picture gives no light that shows above noise."
    if keep.sum() < rules.fewest_pictures:
        return (
            keep,
            FitStatus.TOO_FEW_DATA,
            (
                f"Expected at least {rules.fewest_pictures} unclipped pictures, found {keep.sum()} "
                f"({(~keep).sum()} clipped)."
            ),
        )
    return keep, FitStatus.CONVERGED, ""


def _shows_light(data: BackscatterData, rules: BackscatterRules) -> bool:
    shots = data.shots
    excess = shots.rate[0] - shots.rate[-1] * (shots.exposure_s[-1] / shots.exposure_s[0])
    sigma = excess / np.sqrt(np.maximum(shots.rest[0] + shots.rest[-1], LEAST_VARIANCE * shots.shot[0] ** 2))
    total = float(sigma.sum()) / np.sqrt(sigma.size)
    return bool(total > rules.present_sigma) and float(np.percentile(sigma, 90)) > rules.visible_sigma


def result_of(found: Found, data: BackscatterData, rig: RigDescription, clipped: list[str]) -> FitResult[Backscatter]:
    """The fit as a result; ``clipped`` names the pictures that were left out before it."""
    fitted, template = found.state.fitted, found.problem.template
    rest = residual_pattern(found)
    values = value_moments(found, rest.inflation)
    moved = pitch_error(values.mean, rig)
    scale = np.where(np.array(NAMES) == "pupil_diameter_mm", 1 / footprint_share(rig), 1.0)
    cov = (values.cov + np.outer(moved, moved)) * np.outer(scale, scale)
    shape = data.shots.rate.shape[2:]
    rays = grid_rays(template.geometry, shape, template.step, np.arange(shape[0] * shape[1]))
    window = window_for(template, linear_of(fitted.found.x), rays, slack=0.5)
    posterior = term_posterior(replace(template, window=window), data, found, rest.inflation)
    status, advice = _status(found)
    used = fitted.used
    # What the profiled mask took from the residuals' variance is given back.
    z = fitted.z[used] * np.sqrt(used.sum() / found.dof)
    return FitResult(
        name="backscatter",
        term=posterior.term_at(posterior.mean),
        status=status,
        estimates=estimates(NAMES, UNITS, values.mean * scale, cov),
        cov=cov,
        chi2_dof=fitted.chi2 / found.dof,
        samples=int(used.sum()),
        candidates=found.orders.candidates,
        diagnostics=_diagnostics(found, rest, data),
        notes=(*advice, *_notes(found, rest, data, clipped)),
        outliers=_outliers(found, data, clipped),
        residuals=residual_sample(_places(found)[np.nonzero(used)[2]] * template.step, z),
        posterior=posterior,
    )


def residual_pattern(found: Found) -> MisfitTest:
    """Whether residuals of a shot and colour hang together, over parts of the sensor or over all of it."""
    fitted, cells = found.state.fitted, found.problem.rules.cells
    used, places = fitted.used, _places(found)
    low, high = places.min(axis=0), places.max(axis=0)
    column, row = np.minimum((places - low) / np.maximum(high - low, 1e-9) * cells, cells - 1).astype(int).T
    groups = np.arange(used[..., 0].size).reshape(*used.shape[:2], 1)
    scale = max(fitted.chi2 / found.dof, 1.0) * found.dof / max(used.sum(), 1)
    tests = [
        group_means_test(fitted.z.ravel(), (groups * cells**2 + cell).ravel(), used.ravel(), scale)
        for cell in (row * cells + column, np.zeros(len(places), dtype=int))
    ]
    return sharper(*tests)


def _places(found: Found) -> Float[np.ndarray, "n 2"]:
    """Grid columns and rows of the positions."""
    template = found.problem.template
    rows, columns = np.divmod(found.problem.flat, template.columns // template.step)
    return np.stack([columns, rows], axis=1).astype(np.float64)


def _status(found: Found) -> tuple[FitStatus, tuple[str, ...]]:
    """How the fit ended, and what to do about it beyond what the status says."""
    solved, problem, rules = found.state.fitted.found, found.problem, found.problem.rules
    if not solved.converged:
        return FitStatus.NOT_CONVERGED, ("Check panel and mounting in the rig's description.",)
    if window_for(problem.template, linear_of(solved.x), problem.samples.rays, slack=0.0) > problem.template.window:
        return FitStatus.POOR_FIT, (
            "The pictures ask for footprints on the panel of more than three times their nominal width. Check lens, "
            "stand-off and pitch in the description, and that every frame was stored with the picture that was shown.",
        )
    sigma = np.sqrt(np.maximum(np.diag(solved.cov), 0.0))[_PLACE]
    unsure = (sigma > rules.undetermined * problem.prior.sigma[_PLACE]) & (sigma > np.array(rules.known))
    if unsure.any():
        names = ", ".join(NAMES[k] for k in _PLACE[unsure])
        return FitStatus.TOO_FEW_DATA, (
            f"The pictures do not determine {names}. Show pictures that differ in brightness, colour and shapes, "
            "or expose longer.",
        )
    if found.held_out.excess_of_peak > rules.worst_error:
        return FitStatus.POOR_FIT, (
            f"Pictures held out of the fit are predicted {found.held_out.excess_of_peak:.0%} of their peak wrong, "
            "noise apart. Check that every frame was stored with the picture that the panel showed.",
        )
    bad = found.bad_shots[:-1]
    if bad.mean() > rules.most_outliers:
        return FitStatus.POOR_FIT, (
            f"{bad.sum()} of {bad.size} pictures do not fit the others. Capture again, with exposures of whole periods "
            "of the panel's refresh.",
        )
    return FitStatus.CONVERGED, ()


def _diagnostics(found: Found, rest: MisfitTest, data: BackscatterData) -> tuple[Diagnostic, ...]:
    return (
        Diagnostic("held_out_rms_of_peak", found.held_out.rms_of_peak, "1"),
        Diagnostic("held_out_without_noise_of_peak", found.held_out.excess_of_peak, "1"),
        Diagnostic("model_error_of_white", found.state.model_error, "1"),
        Diagnostic("pattern_p_value", rest.p_value, "1"),
        Diagnostic("pattern_inflation", rest.inflation, "1"),
        Diagnostic("frame_scatter_over_noise", _scatter(data), "1"),
        Diagnostic("pictures", float((~found.bad_shots[1:-1]).sum()), "1"),
        Diagnostic("positions", float(len(found.problem.flat)), "1"),
        Diagnostic("iterations", float(found.state.fitted.found.iterations), "1"),
    )


def _scatter(data: BackscatterData) -> float:
    """Variance between the frames of a shot over what the noise model says, as the median of all shots; 0: unknown."""
    known = data.shots.scatter[:-1][np.isfinite(data.shots.scatter[:-1])]
    return float(np.median(known)) if known.size else 0.0


def _notes(found: Found, rest: MisfitTest, data: BackscatterData, clipped: list[str]) -> tuple[str, ...]:
    notes = [f"{len(clipped)} clipped pictures left out."] if clipped else []
    if found.state.model_error > 0:
        notes.append(f"Ratios to white are modelled to {found.state.model_error:.2%} only; that counts as noise.")
    if rest.inflation > 1:
        notes.append(
            f"Residuals hang together (p = {rest.p_value:.1g}); all sigmas are {np.sqrt(rest.inflation):.1f} times "
            "those of independent ones."
        )
    if _scatter(data) > found.problem.rules.steady:
        notes.append(
            f"Frames of one picture vary {_scatter(data):.1f} times as much as noise: the panel may flicker. Expose "
            "for whole periods of its refresh."
        )
    held = [name for name, free in zip(NAMES, found.order.free, strict=True) if not free]
    if held:
        notes.append(f"Held: {', '.join(held)}.")
    return (*notes, "Estimates start from the rig's values with its tolerances as prior sigma.")


def _outliers(found: Found, data: BackscatterData, clipped: list[str]) -> tuple[Outliers, ...]:
    """What was left out, by rule."""
    names, usable, bad = ("white", *data.names), found.problem.samples.usable[:-1], found.bad_shots[:-1]
    columns, flat = found.problem.template.columns // found.problem.template.step, found.problem.flat

    def named(which: Bool[np.ndarray, "shots 3 n"]) -> list[str]:
        return [
            f"{names[i]} {'RGB'[c]} bin ({flat[n] % columns}, {flat[n] // columns})" for i, c, n in np.argwhere(which)
        ]

    return (
        *outliers(f"pictures with more than {found.problem.rules.most_clipped:.0%} of their bins clipped", clipped),
        *BAD_PICTURES.listed(name for name, one in zip(names, bad, strict=True) if one),
        *outliers("bins with clipped samples", named(~usable)),
        *BAD_BINS.listed(named(usable & ~found.state.usable[:-1] & ~bad[:, None, None])),
    )
