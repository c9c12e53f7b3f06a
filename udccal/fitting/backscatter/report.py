"""The result of a backscatter fit: the term, error bars with the model's error in them, what was found on the way."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from udccal.fitting.backscatter.checks import Pattern, listed, pattern
from udccal.fitting.backscatter.data import PanelShots, directions
from udccal.fitting.backscatter.light import Knowledge, Other, mask_of
from udccal.fitting.backscatter.likelihood import chi2_of
from udccal.fitting.backscatter.posterior import stated
from udccal.fitting.backscatter.select import Choice
from udccal.fitting.backscatter.solve import window_for
from udccal.fitting.backscatter.vector import (
    NAMES,
    UNITS,
    footprint_share,
    pitch_share,
    values_of,
    with_vector,
)
from udccal.models.backscatter import Backscatter, grid_positions
from udccal.numerics import in_float64
from udccal.result import Candidate, Diagnostic, Estimate, FitResult, FitStatus, Outliers, ResidualSample
from udccal.rig import RigDescription

_WORST_ERROR = 0.05
# A fit of pictures that do not determine where the footprints lie: sigma over that of the prior.
_UNDETERMINED = 0.5
_PLACE = np.array([1, 2, 6, 7])
# Known as well as this from the rig's description, smooth pictures need not tell it: a tenth of a length, half a pixel.
_KNOWN = np.array([0.1, 0.1, 0.5, 0.5])
# Rates between frames of one shot vary this much more than noise when the panel flickers.
_STEADY = 1.3
_MOST_ODD = 0.25
# Candidates less probable than this do not widen the error bars of predicted light.
_POSSIBLE = 1e-3
_MOST_RESIDUALS = 6000


def told(choice: Choice, shots: PanelShots, rig: RigDescription, clipped: list[str]) -> FitResult[Backscatter]:
    """The fit as a result; ``clipped`` names the pictures that were left out before it.

    The term has the most probable parameters. Estimates are means over what is possible, so that their errors are as
    often to either side as sigma says; the two differ where a parameter is known to some tens of per cent only.
    """
    state = choice.state
    rest, known = residual_pattern(choice), known_from(choice)
    values = stated(choice, rest.inflation)
    moved = pitch_share(values.mean, rig)
    scale = np.where(np.array(NAMES) == "pupil_mm", 1 / footprint_share(rig), 1.0)
    cov = (values.cov + np.outer(moved, moved)) * np.outer(scale, scale)
    sigma = np.sqrt(np.maximum(np.diag(cov), 0.0))
    status, advice = _status(choice)
    return FitResult(
        name="backscatter",
        term=_term(known, mask_of(known, shots)),
        status=status,
        estimates=tuple(
            Estimate(name, float(value), float(one), unit)
            for name, value, one, unit in zip(NAMES, values.mean * scale, sigma, UNITS, strict=True)
        ),
        cov=cov,
        chi2_dof=chi2_of(state.fitted, choice.problem.seen) / choice.freedom,
        samples=int((state.fitted.weight > 0).sum()),
        candidates=tuple(
            Candidate(one.order.name, one.order.parameters, one.criterion, one.order is choice.order)
            for one in choice.rivals
        ),
        diagnostics=_diagnostics(choice, rest, shots),
        notes=(*advice, *_notes(choice, rest, shots, clipped)),
        outliers=_outliers(choice, shots, clipped),
        residuals=_residuals(choice),
    )


def _residuals(choice: Choice) -> ResidualSample:
    """Of evenly drawn bins, with what the profiled mask took from their variance given back."""
    fitted = choice.state.fitted
    used = np.flatnonzero(fitted.weight > 0)
    drawn = used[:: max(1, -(-len(used) // _MOST_RESIDUALS))]
    given_back = np.sqrt(len(used) / max(choice.freedom, 1.0))
    places_px = _places(choice)[drawn % fitted.weight.shape[2]] * choice.problem.template.step
    return ResidualSample(places_px, fitted.z.ravel()[drawn] * given_back)


def known_from(choice: Choice) -> Knowledge:
    """Parameters and covariance, the latter widened where residuals hang together."""
    solution = choice.state.fitted.solution
    return Knowledge(
        template=choice.problem.template,
        x=solution.x,
        cov=solution.cov * residual_pattern(choice).inflation,
        share=choice.state.share,
        kept=tuple(bool(one) for one in ~choice.odd_shots),
        others=tuple(
            Other(one.solution.x, one.solution.cov, float(probability))
            for one, probability in zip(choice.rivals, choice.odds, strict=True)
            if one.order is not choice.order and probability > _POSSIBLE
        ),
    )


def residual_pattern(choice: Choice) -> Pattern:
    """Whether residuals hang together over the sensor."""
    return pattern(choice.state.fitted, _places(choice), choice.freedom)


def _places(choice: Choice) -> Float[np.ndarray, "n 2"]:
    template = choice.problem.template
    rows, columns = np.divmod(choice.problem.flat, template.columns // template.step)
    return np.stack([columns, rows], axis=1).astype(np.float64)


def _status(choice: Choice) -> tuple[FitStatus, tuple[str, ...]]:
    """How the fit ended, and what to do about it beyond what the status says."""
    solution, prior = choice.state.fitted.solution, choice.problem.prior
    if not solution.converged:
        return FitStatus.NOT_CONVERGED, ("Check panel and mounting in the rig's description.",)
    template = choice.problem.template
    if window_for(template, solution.x, choice.problem.seen.rays, slack=0.0) > template.window:
        return FitStatus.POOR_FIT, (
            "The pictures ask for footprints on the panel of more than three times their nominal width. Check lens, "
            "stand-off and pitch in the description, and that every frame was stored with the picture that was shown.",
        )
    sigma = np.sqrt(np.maximum(np.diag(solution.cov), 0.0))[_PLACE]
    unsure = (sigma > _UNDETERMINED * prior.sigma[_PLACE]) & (sigma > _KNOWN)
    if unsure.any():
        names = ", ".join(NAMES[k] for k in _PLACE[unsure])
        return FitStatus.TOO_FEW_DATA, (
            f"The pictures do not determine {names}. Show pictures that differ in brightness, colour and shapes, "
            "or expose longer.",
        )
    if choice.held_out.excess_of_peak > _WORST_ERROR:
        return FitStatus.POOR_FIT, (
            f"Pictures held out of the fit are predicted {choice.held_out.excess_of_peak:.0%} of their peak wrong, "
            "noise apart. Check that every frame was stored with the picture that the panel showed.",
        )
    if choice.odd_shots.mean() > _MOST_ODD:
        return FitStatus.POOR_FIT, (
            f"{choice.odd_shots.sum()} of {choice.odd_shots.size} pictures do not fit the others. Capture again, with "
            "exposures of whole periods of the panel's refresh.",
        )
    return FitStatus.CONVERGED, ()


def _diagnostics(choice: Choice, rest: Pattern, shots: PanelShots) -> tuple[Diagnostic, ...]:
    state = choice.state
    return (
        Diagnostic("held_out_rms_of_peak", choice.held_out.rms_of_peak, "1"),
        Diagnostic("held_out_without_noise_of_peak", choice.held_out.excess_of_peak, "1"),
        Diagnostic("model_error_of_white", state.share, "1"),
        Diagnostic("pattern_p_value", rest.p_value, "1"),
        Diagnostic("pattern_inflation", rest.inflation, "1"),
        Diagnostic("frame_scatter_over_noise", _scatter(shots), "1"),
        Diagnostic("pictures", float((~choice.odd_shots[1:]).sum()), "1"),
        Diagnostic("positions", float(len(choice.problem.flat)), "1"),
        Diagnostic("iterations", float(state.fitted.solution.iterations), "1"),
    )


def _scatter(shots: PanelShots) -> float:
    """Variance between the frames of a shot over what the noise model says, as the median of all shots; 0: unknown."""
    known = [one.scatter for one in (shots.white, *shots.seen) if np.isfinite(one.scatter)]
    return float(np.median(known)) if known else 0.0


def _notes(choice: Choice, rest: Pattern, shots: PanelShots, clipped: list[str]) -> tuple[str, ...]:
    notes = [f"{len(clipped)} clipped pictures left out."] if clipped else []
    if choice.state.share > 0:
        notes.append(f"Ratios to white are modelled to {choice.state.share:.2%} only; that counts as noise.")
    if rest.inflation > 1:
        notes.append(
            f"Residuals hang together (p = {rest.p_value:.1g}); all sigmas are {np.sqrt(rest.inflation):.1f} times "
            "those of independent ones."
        )
    if _scatter(shots) > _STEADY:
        notes.append(
            f"Frames of one picture vary {_scatter(shots):.1f} times as much as noise: the panel may flicker. Expose "
            "for whole periods of its refresh."
        )
    held = choice.order.held()
    if held:
        notes.append(f"Held: {', '.join(held)}.")
    return (*notes, "Estimates start from the rig's values with its tolerances as prior sigma.")


def _outliers(choice: Choice, shots: PanelShots, clipped: list[str]) -> tuple[Outliers, ...]:
    """What was left out, by rule."""
    names = ("white", *shots.names)
    odd = [name for name, one in zip(names, choice.odd_shots, strict=True) if one]
    gone = choice.problem.seen.usable & ~choice.state.usable & ~choice.odd_shots[:, None, None]
    clips = ~choice.problem.seen.usable
    return (
        *listed("pictures with more than 2 % of their bins clipped", clipped),
        *listed("pictures whose brightness or pattern is unlike the others by more than 6 robust sigma", odd),
        *listed("bins with clipped samples", _named(clips, names, choice)),
        *listed("bins off by more than 6 robust sigma, and bins with most pictures off", _named(gone, names, choice)),
    )


def _named(which: Bool[np.ndarray, "shots 3 n"], names: tuple[str, ...], choice: Choice) -> list[str]:
    columns = choice.problem.template.columns // choice.problem.template.step
    return [
        f"{names[i]} {'RGB'[c]} bin ({choice.problem.flat[n] % columns}, {choice.problem.flat[n] // columns})"
        for i, c, n in np.argwhere(which)
    ]


@in_float64
def _term(known: Knowledge, mask: Float[np.ndarray, "3 grid_rows grid_columns"]) -> Backscatter:
    """The fitted term in numpy, its window no larger than the footprints on the whole grid need."""
    template, x = known.template, known.x
    columns, rows = (np.asarray(a) for a in grid_positions(template.columns, template.rows, template.step))
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    rays = directions(template.geometry, pixels)
    fitted, values = with_vector(template, jnp.asarray(x)), values_of(x)
    return Backscatter(
        geometry=template.geometry,
        mask=mask,
        mix=np.asarray(fitted.mix, dtype=np.float64),
        gamma=np.float64(values[0]),
        pitch_mm=np.asarray(template.pitch_mm, dtype=np.float64),
        pupil_mm=np.float64(values[2]),
        distance_mm=np.float64(values[1]),
        emitters_px=np.asarray(fitted.emitters_px, dtype=np.float64),
        softness_px=np.float64(values[3]),
        reflection=np.float64(values[4]),
        reflection_mm=np.float64(values[5]),
        columns=template.columns,
        rows=template.rows,
        cfa=template.cfa,
        step=template.step,
        window=window_for(template, x, rays, slack=0.5),
    )
