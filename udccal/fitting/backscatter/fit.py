"""Backscatter fit: from averages of the panel's pictures under blackout to the panel's light on the sensor."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from jaxtyping import Bool, Float, Float32

from udccal.fitting.backscatter.data import BackscatterData, Binned, grid_rays
from udccal.fitting.backscatter.model import Rays, Usable, ratios, ratios_and_jacobian, window_for
from udccal.fitting.backscatter.orders import (
    BAD_BINS,
    BAD_PICTURES,
    Found,
    disagreement,
    residual_pattern,
    search,
    value_moments,
)
from udccal.fitting.backscatter.parameters import (
    DEPTH,
    DISTANCE,
    NAMES,
    OFFSET,
    PUPIL,
    BackscatterRules,
    Moments,
    Vector,
    footprint_per_pupil,
    linear_of,
    linear_slope,
    nominal_of,
    with_linear,
)
from udccal.fitting.backscatter.solve import Problem, Profile
from udccal.fitting.engine.gaussian import Posterior, square_root
from udccal.fitting.engine.misfit import MisfitTest
from udccal.fitting.engine.report import coarse, estimates, priors_of, residual_sample
from udccal.fitting.engine.robust import outliers
from udccal.fitting.nominal import absent_backscatter
from udccal.models.backscatter import Backscatter
from udccal.models.geometry import Geometry
from udccal.numerics import in_float64
from udccal.result import Diagnostic, FitResult, FitStatus, Outliers
from udccal.rig import RigDescription

# Interpolation never combines bins at this distance.
_TILE = 4
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
    """
    rules = rules or BackscatterRules()
    keep = data.shots.clipped.mean(axis=(1, 2, 3))[1:-1] <= rules.most_clipped
    if (unusable := _unusable(data.shots, keep, rules)) is not None:
        return FitResult.failed("backscatter", absent_backscatter(rig, geometry), *unusable)
    clipped = [name for name, kept in zip(data.names, keep, strict=True) if not kept]
    used = data.only(keep)
    return result_of(search(Problem.of(used, geometry, rig, rules)), used, rig, clipped)


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
    present = float(sigma.sum()) > rules.present_sigma * np.sqrt(sigma.size)
    if not (present and float(np.percentile(sigma, 90)) > rules.visible_sigma):
        return FitStatus.ABSENT, "The white picture gives no light that shows above noise."
    found = f"found {keep.sum()} ({(~keep).sum()} clipped)"
    if keep.sum() < rules.fewest_pictures:
        return FitStatus.TOO_FEW_DATA, f"Expected at least {rules.fewest_pictures} unclipped pictures, {found}."
    return None


def result_of(found: Found, data: BackscatterData, rig: RigDescription, clipped: list[str]) -> FitResult[Backscatter]:
    """Return the fit as a result; ``clipped`` names the pictures that were left out before it."""
    fitted, template, used = found.fitted, found.problem.template, found.fitted.used
    rest = residual_pattern(found)
    wider = disagreement(found)
    values = value_moments(found, rest.inflation)
    # A pattern has widened all parameters already.
    scale = np.sqrt(np.maximum(wider / rest.inflation, 1.0))
    values = replace(values, cov=values.cov * np.outer(scale, scale))
    # Pictures give lengths in panel pixels only: lengths change with the pitch.
    pitch, scale = rig.panel.pitch_mm, np.ones(len(NAMES))
    moved = np.where(np.isin(np.arange(len(NAMES)), [DISTANCE, PUPIL, DEPTH]), values.mean, 0.0)
    scale[PUPIL] = 1 / footprint_per_pupil(rig)
    cov = (values.cov + (pitch.tolerance / pitch.value) ** 2 * np.outer(moved, moved)) * np.outer(scale, scale)
    priors = priors_of(NAMES, *(part * scale for part in nominal_of(found.problem.prior)))
    posterior = term_posterior(data, found, np.maximum(wider, rest.inflation))
    term, (status, advice) = posterior.term, _status(found)
    # Variance between the frames of a shot over the noise model's, as the median of all shots; 0: unknown.
    known = data.shots.scatter[:-1][np.isfinite(data.shots.scatter[:-1])]
    scatter = float(np.median(known)) if known.size else 0.0
    return FitResult(
        name="backscatter",
        term=term,
        status=status,
        estimates=estimates("backscatter", NAMES, values.mean * scale, cov, priors),
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
        notes=(*advice, *_notes(found, rest, wider, scatter, clipped)),
        outliers=_outliers(found, data, clipped),
        # The eliminated mask reduces the residuals' variance; the factor corrects for it.
        residuals=residual_sample(
            found.places[np.nonzero(used)[2]] * template.step, fitted.z[used] * np.sqrt(used.sum() / found.dof)
        ),
        posterior=posterior,
        map_sigma=_mask_sigma(term, posterior),
    )


def _mask_sigma(term: Backscatter, posterior: Posterior[Backscatter]) -> Float32[np.ndarray, "3 down across"]:
    """Sigma of the light of white by the frames' noise, at the fitted kernels, in e-/s over cells of the sensor."""
    noise = np.repeat([0.0, 1.0], [len(NAMES), len(posterior.mean) - len(NAMES)])
    # The noise has random signs, and the mask is never below 0: the brighter one is a sigma above the mean.
    up, down = (posterior.term_at(posterior.mean + sign * noise).mask for sign in (1.0, -1.0))
    sigma = np.maximum(np.maximum(up, down) - np.asarray(term.mask), 1e-30)
    return np.asarray(coarse(sigma**-2.0, _CELLS) ** -0.5, dtype=np.float32)


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


def _notes(found: Found, rest: MisfitTest, wider: Vector, scatter: float, clipped: list[str]) -> tuple[str, ...]:
    notes = [f"{len(clipped)} clipped pictures left out."] if clipped else []
    if found.model_error > 0:
        notes.append(f"Ratios to white are modelled to {found.model_error:.2%} only; that counts as noise.")
    if rest.inflation > 1:
        notes.append(
            f"Residuals have a pattern (p = {rest.p_value:.1g}); all sigmas are {np.sqrt(rest.inflation):.1f} times "
            "those of independent ones."
        )
    if (most := float(np.sqrt(wider.max()))) > 1:
        notes.append(
            "Parts of the sensor ask for different kernels: the model is not true there. Sigmas are up to "
            f"{most:.1f} times those of a true model ({NAMES[int(wider.argmax())]})."
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
    places = found.places.astype(int)

    def named(which: Usable) -> list[str]:
        return [f"{names[i]} {'RGB'[c]} bin ({places[n, 0]}, {places[n, 1]})" for i, c, n in np.argwhere(which)]

    return (
        *outliers(f"pictures with more than {found.problem.rules.most_clipped:.0%} of their bins clipped", clipped),
        *BAD_PICTURES.listed(name for name, one in zip(names, bad, strict=True) if one),
        *outliers("bins with clipped samples", named(~usable)),
        *BAD_BINS.listed(named(usable & ~found.usable[:-1] & ~bad[:, None, None])),
    )


@final
@dataclass(frozen=True)
class TermAt:
    """The term as a function of its parameters (``linear_of``), and of ``_TILE`` squared numbers of the mask's noise.

    The mask is the most probable one for all shots and follows the parameters linearly. Bins with the same number are
    so far from each other that no interpolated value depends on two of them. Their signs are random, so that sums over
    the sensor are right on average.
    """

    template: Backscatter
    data: BackscatterData
    used: Bool[np.ndarray, " shots"]
    model_error: float
    theta: Vector

    @in_float64
    def __call__(self, parameters: Float[np.ndarray, " n"]) -> Backscatter:
        """Return the term; its mask is never below 0."""
        theta, noise = parameters[: len(self.theta)], parameters[len(self.theta) :].reshape(_TILE, _TILE)
        mask, sigma = self._mask
        rows, columns = mask.shape[1:]
        mask = mask + sigma * np.tile(noise, (-(-rows // _TILE), -(-columns // _TILE)))[:rows, :columns]
        if (moved := theta - self.theta).any():
            mask = mask + np.einsum("k,kcij->cij", moved, self._mask_jacobian)
        return replace(with_linear(self.template, theta), mask=np.maximum(mask, 0.0))

    @functools.cached_property
    def _mask(self) -> tuple[Float[np.ndarray, "3 a b"], Float[np.ndarray, "3 a b"]]:
        """Light of white over the whole grid, and its sigma with a random sign, in e-/s."""
        found, shape = [best for _, best in self._profiles(512)], self.data.shots.rate.shape[1:]
        mask = np.concatenate([np.maximum(one.mask, 0.0) for one in found], axis=1)
        sigma = np.concatenate([np.maximum(one.information, 1e-30) for one in found], axis=1) ** -0.5
        sign = np.random.default_rng(0).choice([-1.0, 1.0], mask.shape)
        return mask.reshape(shape), (sign * sigma).reshape(shape)

    @functools.cached_property
    def _mask_jacobian(self) -> Float[np.ndarray, "18 3 a b"]:
        """Derivatives of the mask by the parameters, computed only when the posterior is used."""
        parts = [
            best.mask_jacobian(ratios_and_jacobian(self.template, self.theta, rays, self.data.pictures)[1])
            for rays, best in self._profiles(256)
        ]
        return np.concatenate(parts, axis=2).reshape(-1, *self.data.shots.rate.shape[1:])

    def _profiles(self, size: int) -> Iterator[tuple[Rays, Profile]]:
        """Rays, mask and dark signal of ``size`` positions at once: first with the data's weights, then the model's."""
        shots, template = self.data.shots, self.template
        every = np.arange(shots.rate[0, 0].size)
        for flat in np.split(every, every[size::size]):
            rays, seen = grid_rays(template.geometry, shots.rate.shape[2:], template.step, flat), shots.at(flat)
            usable = seen.usable & self.used[:, None, None]
            ratio = ratios(template, self.theta, rays, self.data.pictures)
            best = Profile.of(seen, ratio, np.where(usable, seen.first_weights(), 0.0))
            for _ in range(2):
                best = Profile.of(seen, ratio, seen.weights(best.mask * ratio, best.mask, self.model_error, usable))
            yield rays, best

    def posterior(self, cov: Float[np.ndarray, "18 18"]) -> Posterior[Backscatter]:
        """Return the posterior with this covariance of the parameters, and with the mask's noise."""
        count, noise = len(cov), _TILE**2
        factor = np.eye(count + noise)
        factor[:count, :count] = square_root(cov)
        return Posterior(np.concatenate([self.theta, np.zeros(noise)]), factor, self)


@in_float64
def term_posterior(data: BackscatterData, found: Found, inflation: Vector) -> Posterior[Backscatter]:
    """Return the whole term's posterior: its parameters, the mask that follows them, its noise, and other orders.

    The model error of a picture (``model_error_of_white``) is not an error of the term and adds to it.

    Args:
        data, found: all shots; the chosen order's fit, and the others.
        inflation: factors of the parameters' variances.
    """
    theta, orders, parts = linear_of(found.fitted.found.x), found.orders, []
    template, shape = found.problem.template, data.shots.rate.shape[2:]
    rays = grid_rays(template.geometry, shape, template.step, np.arange(shape[0] * shape[1]))
    template = replace(template, window=window_for(template, theta, rays, slack=0.5))
    for one in orders.tried:
        fit, factor = (found.fitted.found, inflation) if one is orders.best else (one.fit.found, np.ones(len(theta)))
        slope = linear_slope(fit.x) * np.sqrt(factor)
        parts.append(Moments(linear_of(fit.x), fit.cov * np.outer(slope, slope)))
    cov = Moments.mixture(parts, orders.probabilities, theta).cov
    return TermAt(template, data, ~found.bad_shots, found.model_error, theta).posterior(cov)
