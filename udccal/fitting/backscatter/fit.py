"""Backscatter fit: from averages of the panel's pictures under blackout to the panel's light on the sensor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool

from udccal.arguments import check_kind
from udccal.errors import FitError
from udccal.fitting.backscatter.data import BackscatterData, Binned
from udccal.fitting.backscatter.model import Usable, grid_step, window_for
from udccal.fitting.backscatter.other_light import light_besides
from udccal.fitting.backscatter.parameters import (
    DEPTH,
    DISTANCE,
    NAMES,
    OFFSET,
    PUPIL,
    BackscatterRules,
    footprint_per_pupil,
    linear_of,
    linear_slope,
    value_slope,
    values_of,
)
from udccal.fitting.backscatter.posterior import Misfits, TermAt, linear_cov, scaled, value_moments
from udccal.fitting.backscatter.search import BAD_BINS, BAD_PICTURES, Found, search
from udccal.fitting.backscatter.solve import Problem
from udccal.fitting.engine.report import coarse, estimates, priors_of, residual_sample
from udccal.fitting.engine.robust import outliers
from udccal.fitting.nominal import absent_backscatter
from udccal.models.backscatter import Backscatter
from udccal.models.geometry import Geometry
from udccal.numerics import in_float64
from udccal.result import Diagnostic, FitResult, FitStatus, Outliers
from udccal.rig import RigDescription

# Cells of the map of sigma, down and across.
_CELLS = 48


@in_float64
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

    Raises:
        FitError: when the data's grid is not that of the rig's sensor.
    """
    check_kind(data, BackscatterData, "Give the binned rates as one.", FitError)
    rules, step, grid = rules or BackscatterRules(), grid_step(rig), data.shots.rate.shape
    shape = rig.camera.rows // step, rig.camera.columns // step
    if grid[0] and grid[2:] != shape:
        raise FitError(f"Expected a grid of {shape} bins for this sensor, found {grid[2:]}. Bin all of the sensor.")
    keep = data.shots.clipped.mean(axis=(1, 2, 3))[1:-1] <= rules.most_clipped
    if (unusable := _unusable(data.shots, keep, rules)) is not None:
        return FitResult.failed("backscatter", absent_backscatter(rig, geometry), *unusable)
    clipped = [name for name, kept in zip(data.names, keep, strict=True) if not kept]
    used = data.only(keep)
    found = search(Problem.of(used, geometry, rig, rules))
    return result_of(found, replace(used, shots=used.shots.with_white(found.problem.white)), rig, clipped)


def _unusable(
    shots: Binned, keep: Bool[np.ndarray, " pictures"], rules: BackscatterRules
) -> tuple[FitStatus, str] | None:
    """Return a status and a note if white, dark and the pictures to keep allow no fit."""
    if len(shots.rate) < 2:
        note = "Expected the steps backscatter/white and backscatter/dark, found that they were not captured."
        return FitStatus.TOO_FEW_DATA, note
    if (clipped := shots.clipped[0].mean()) > rules.most_clipped:
        return FitStatus.SATURATED, f"{clipped:.0%} of the white picture's bins hold clipped samples."
    sigma = shots.excess[0] / np.sqrt(shots.variance(np.zeros(shots.rate.shape))[0] + shots.rest[-1])
    if not np.percentile(sigma, 90) > rules.visible_sigma:
        return FitStatus.ABSENT, "The white picture gives no light that shows above noise."
    found = f"found {keep.sum()} ({(~keep).sum()} clipped)"
    if keep.sum() < rules.fewest_pictures:
        return FitStatus.TOO_FEW_DATA, f"Expected at least {rules.fewest_pictures} unclipped pictures, {found}."
    return None


def result_of(found: Found, data: BackscatterData, rig: RigDescription, clipped: list[str]) -> FitResult[Backscatter]:
    """Return the fit as a result; ``clipped`` names the pictures that were left out before it."""
    fitted, used, problem = found.fitted, found.fitted.used, found.problem
    misfits, term_at, (status, advice) = Misfits.of(found), TermAt.of(data, found), _status(found)
    inflation = misfits.pattern.inflation
    values = value_moments(found, inflation)
    # A pattern has widened all parameters already.
    cov = scaled(values.cov, np.sqrt(np.maximum(misfits.wider / inflation, 1.0)))
    cov += scaled(misfits.by_panel, value_slope(fitted.found.x))
    # Pictures give lengths in panel pixels only: lengths change with the pitch.
    pitch, lengths = rig.panel.pitch_mm, np.isin(np.arange(len(NAMES)), [DISTANCE, PUPIL, DEPTH]) * values.mean
    cov += (pitch.tolerance / pitch.value) ** 2 * np.outer(lengths, lengths)
    scale = np.where(np.arange(len(NAMES)) == PUPIL, 1 / footprint_per_pupil(rig), 1.0)
    cov = scaled(cov, scale)
    by_panel = scaled(misfits.by_panel, linear_slope(fitted.found.x))
    posterior = term_at.posterior(linear_cov(found, np.maximum(misfits.wider, inflation)) + by_panel)
    nominal = values_of(problem.prior.mean)
    priors = priors_of(NAMES, nominal * scale, problem.prior.sigma * value_slope(nominal) * scale)
    # Variance between the frames of a shot over the noise model's, as the median of all shots; 0: unknown.
    known = data.shots.scatter[:-1][np.isfinite(data.shots.scatter[:-1])]
    scatter = float(np.median(known)) if known.size else 0.0
    return FitResult(
        name="backscatter",
        term=posterior.term,
        status=status,
        estimates=estimates("backscatter", NAMES, values.mean * scale, cov, priors),
        cov=cov,
        chi2_dof=fitted.best.chi2 / found.dof,
        samples=int(used.sum()),
        candidates=found.orders.candidates,
        diagnostics=(
            Diagnostic("held_out_without_noise_of_peak", found.held_out, "1"),
            Diagnostic("model_error_of_white", float(np.hypot(found.model_error, misfits.curve.rms)), "1"),
            Diagnostic("brightness_of_white", found.problem.white, "1"),
            Diagnostic("pattern_p_value", misfits.pattern.p_value, "1"),
            Diagnostic("pattern_inflation", inflation, "1"),
            Diagnostic("frame_scatter_over_noise", scatter, "1"),
            Diagnostic("pictures", float(found.good[1:-1].sum()), "1"),
        ),
        notes=(*advice, *_notes(found, misfits, scatter, clipped)),
        outliers=_outliers(found, data, clipped),
        # The eliminated mask reduces the residuals' variance; the factor corrects for it.
        residuals=residual_sample(
            found.places[np.nonzero(used)[2]] * float(problem.template.step),
            fitted.best.z[used] * np.sqrt(used.sum() / found.dof),
        ),
        posterior=posterior,
        # Of the light of white by the frames' noise, at the fitted kernels.
        map_sigma=np.asarray(coarse(term_at.mask[1] ** -2.0, _CELLS) ** -0.5, dtype=np.float32),
    )


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
    bad = ~found.good[:-1]
    if bad.mean() > rules.most_outliers:
        return FitStatus.POOR_FIT, (
            f"{bad.sum()} of {bad.size} pictures do not fit the others. Capture again, with exposures of whole periods "
            "of the panel's refresh.",
        )
    return FitStatus.CONVERGED, ()


def _notes(found: Found, misfits: Misfits, scatter: float, clipped: list[str]) -> tuple[str, ...]:
    notes = [f"{len(clipped)} clipped pictures left out."] if clipped else []
    if found.without_dark:
        red, green, blue = 100 * light_besides(found.problem, found.fitted.best)
        notes.append(
            f"White and pictures have light that the dark frame has not, {red:.2g}, {green:.2g} and {blue:.2g} % of "
            "white in red, green and blue; the dark frame is left out. Keep all light out, and the panel's power on, "
            "for every step."
        )
    if (white := found.problem.white) != 1:
        notes.append(
            f"White has {100 * white:.3g} % of the brightness that the pictures predict, and counts at theirs: the "
            "panel limits its power, or bends near white. Lower its brightness, or switch the limiter off; else "
            "restoring takes too much off under bright pictures."
        )
    if found.model_error > 0:
        notes.append(f"Ratios to white are modelled to {found.model_error:.2%} only; that counts as noise.")
    if misfits.pattern.inflation > 1:
        notes.append(
            f"Residuals have a pattern (p = {misfits.pattern.p_value:.1g}); all sigmas are "
            f"{np.sqrt(misfits.pattern.inflation):.1f} times those of independent ones."
        )
    if (curve := misfits.curve).test.found:
        notes.append(
            f"The panel's light is no power of its codes (p = {curve.test.p_value:.1g}): at code {curve.code} it is "
            f"{100 * curve.off:+.2g} % of that at 255 off. Sigmas include what that moves. Let the panel show the full "
            "range of codes, without picture mode or raised black."
        )
    if misfits.brightness > 0:
        notes.append(
            f"The panel's brightness differs by {100 * misfits.brightness:.2g} % from picture to picture (p = "
            f"{misfits.brightness_test.p_value:.1g}), which sigmas include. Hold it, and expose for whole periods of "
            "its refresh."
        )
    if (most := float(np.sqrt(misfits.wider.max()))) > 1:
        notes.append(
            "Parts of the sensor ask for different kernels: the model is not true there. Sigmas are up to "
            f"{most:.1f} times those of a true model ({NAMES[int(misfits.wider.argmax())]})."
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
    names, usable, bad = ("white", *data.names), found.problem.seen.usable[:-1], ~found.good[:-1]
    outlying, places = usable & (found.fitted.best.weight[:-1] == 0), found.places

    def named(which: Usable) -> list[str]:
        return [f"{names[i]} {'RGB'[c]} bin ({places[n, 0]}, {places[n, 1]})" for i, c, n in np.argwhere(which)]

    return (
        *outliers(f"pictures with more than {found.problem.rules.most_clipped:.0%} of their bins clipped", clipped),
        *BAD_PICTURES.listed(name for name, one in zip(names, bad, strict=True) if one),
        *outliers("dark frames of other light", ["dark"] if found.without_dark else []),
        *outliers("bins with clipped samples", named(~usable)),
        *BAD_BINS.listed(named(outlying & ~bad[:, None, None])),
    )
