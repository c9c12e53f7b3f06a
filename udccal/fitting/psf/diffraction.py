"""Fit of diffraction to LED pictures: maximum likelihood with the sensor's noise and a model error from the residuals.

Each round is a descent with fixed weights. Between rounds the weights follow the model, and outliers are left out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import ndtr

from udccal.fitting.engine.gaussian import Prior, scaled_inverse, square_root
from udccal.fitting.engine.least_squares import LOG, Blocks, Solution, minimise
from udccal.fitting.engine.misfit import clustered_cov
from udccal.fitting.engine.orders import Attempt, Choice, bic, choose
from udccal.fitting.engine.robust import OutlierRule, outliers
from udccal.fitting.psf.approach import (
    Approach,
    approach,
    approach_without_error,
    far_from_prior,
    solver_rules,
    with_place_held,
)
from udccal.fitting.psf.data import HUBER, PsfRules, Shots, estimate_model_error, left_out
from udccal.fitting.psf.kernel import BAR_WIDTH, FOOTPRINT, Evaluator, Theta, fit_lattice
from udccal.fitting.psf.problem import DiffractionProblem, Place
from udccal.fitting.psf.samples import Light, Own, Samples, gather
from udccal.fitting.psf.start import choose_samples, stands_for
from udccal.models.diffraction import Diffraction
from udccal.models.geometry import Geometry
from udccal.result import Outliers


@final
@dataclass(frozen=True)
class DiffractionFit:
    """The result of a fit of diffraction.

    Attributes:
        shots: the data, at the places that the samples are about.
        model_error: as a fraction of the peak, see ``data.left_out``; 0 where the residuals are noise.
        iterations: sum over all descents.
        shape: comparison by BIC of plain openings, round corners and slants, and these with an opaque bar.
        phase: comparison by BIC of a kernel with the wire's phase to one averaged over it; None where no wire was
            seen. The fits are the phase's strength in the kernel (1 where it agrees with the wire, 0 where the kernel
            does not show it) and its sigma.
    """

    problem: DiffractionProblem
    solution: Solution[Place, Blocks]
    shots: Shots
    model_error: float
    outliers: tuple[Outliers, ...]
    iterations: int
    shape: Choice[Approach] | None = None
    phase: Choice[tuple[float, float]] | None = None

    @property
    def theta(self) -> Float[np.ndarray, " p"]:
        """The shared parameters, in the order of ``start.pack``."""
        return self.solution.place.theta

    @property
    def bar_axis(self) -> int | None:
        """0 or 1 where a bar crosses the openings of columns or rows; None where there is none."""
        axes = np.flatnonzero(self.problem.prior.mean[BAR_WIDTH])
        return int(axes[0]) if axes.size else None

    @property
    def shaped(self) -> bool:
        """True where the openings have round corners and slants."""
        return self.problem.evaluator.shaped

    @property
    def converged(self) -> bool:
        """True if a minimum was reached."""
        return self.solution.converged and bool(np.isfinite(self.theta).all() and np.isfinite(self.noise_cov).all())

    @property
    def noise_cov(self) -> Float[np.ndarray, "p p"]:
        """Covariance of the shared parameters if the model error is independent from sample to sample."""
        return self.solution.with_rest(self.solution.equations.cov())

    def cov(self) -> Float[np.ndarray, "p p"]:
        """Covariance of the shared parameters.

        The model's deviation is common to the samples of a position, so that it averages out over positions only.
        """
        if self.model_error == 0.0:
            return self.noise_cov
        alone = [position.marginal() for position in self.problem.by_position(self.solution.place)]
        return clustered_cov(self.noise_cov, np.stack([a[1] for a in alone]), np.stack([a[0] for a in alone]))

    def refuted_cov(self, kernel_error: float = np.inf) -> Float[np.ndarray, "p p"]:
        """The same where residuals refute the model: its deviation may be common to all positions.

        Then it does not average out over positions as it does in ``cov``. Along directions in which it would change
        the kernel by more than its ``kernel_error`` at positions held out (relative L2), it is no larger than that.
        """
        positions, cov = int((self.problem.samples.weight > 0).any(axis=(1, 2)).sum()), self.cov()
        root = square_root(max(positions - 1, 0) * (cov - self.noise_cov))
        square, ways = np.linalg.eigh(root.T @ self._kernel_metric() @ root)
        most = np.minimum(1.0, kernel_error**2 / np.maximum(square, 1e-300))
        along = root @ ways
        return cov + (along * most) @ along.T

    @property
    def chi2_dof(self) -> float:
        """Reduced chi-squared, with the model error in the weights."""
        dof = max(self.problem.used - self.problem.unknowns, 1)
        return (self.solution.equations.cost - self.problem.prior.cost(self.theta)) / dof

    def efficiency(self, rules: PsfRules, available: int, reported: int) -> float:
        """Return the variance by all samples of all pictures over the fit's variance, as a mean over parameters.

        Samples drawn away from the peak represent all samples there; the fit's pictures represent all that are
        ``available``. The mean is over the first ``reported`` parameters.
        """
        samples, count = self.problem.samples, stands_for(self.shots, rules)[self.problem.samples.index]
        every = replace(self.problem, samples=replace(samples, weight=samples.weight * count))
        information = sum(one.marginal()[0] for one in every.by_position(self.solution.place))
        best = scaled_inverse(self.problem.prior.precision + information * available / self.shots.count)
        return float(np.mean(np.diag(best)[:reported] / np.diag(self.noise_cov)[:reported]))

    def _kernel_metric(self) -> Float[np.ndarray, "p p"]:
        """Return the square of the kernel's relative L2 change at the first position, in all colours, by parameters."""
        one, place = self.problem.samples.at(0), self.solution.place
        # All samples of a colour have equal weights; padding has none.
        even = (one.colour / np.maximum(one.colour.sum(axis=1, keepdims=True), 1)).sum(axis=-1)
        flux = one.flux(place.own[0])
        weight = np.where(flux > 0, even / np.where(flux > 0, flux, 1.0) ** 2, 0.0)
        square = np.einsum("sn,snp,snq->pq", weight, place.by_theta[0], place.by_theta[0], optimize=True)
        return np.asarray(square / float((weight * place.light[0] ** 2).sum()))

    def kernel_sigma(self, cov: Float[np.ndarray, "p p"]) -> float:
        """Return the relative L2 sigma of the kernel at the first position, in all colours."""
        return float(np.sqrt(max(float(np.sum(self._kernel_metric() * cov)), 0.0)))


def fit_diffraction(
    shots: Shots, geometry: Geometry, start: Diffraction, prior: Prior, rules: PsfRules
) -> DiffractionFit:
    """Fit the parameters of diffraction: first to near the minimum, then to the minimum at the places found there.

    ``start`` gives the nodes of the spectra. With a ``visibility``, the footprint's place on the rows is known, and
    ``phase`` says whether the data show it. The mean of the ``prior`` is the start.
    """
    chosen, lattice = choose_samples(shots, rules), fit_lattice(rules.close(shots.half))
    evaluator = Evaluator(np.asarray(start.wavelengths_nm), lattice, bool(start.visibility))
    problem = DiffractionProblem(gather(shots, geometry, chosen), evaluator, prior)
    shape = approach(problem.with_overlaps(prior.mean), rules)
    for attempt in sorted(shape.tried, key=lambda one: one.criterion):
        fit = replace(_finish(attempt.fit, shots, geometry, chosen, rules), shape=Choice(attempt, shape.tried))
        # A bar that vanishes at the minimum was none.
        if fit.bar_axis is None or fit.theta[BAR_WIDTH][fit.bar_axis] > rules.least_bar:
            break
    return fit


def _finish(
    begun: Approach, shots: Shots, geometry: Geometry, chosen: Bool[np.ndarray, "shots rows columns"], rules: PsfRules
) -> DiffractionFit:
    """Go on to the lowest of the minima next to where first descents ended, with the wire's phase or without it."""
    problem, index = begun.problem, begun.problem.samples.index

    def refined(near: Solution[Place, Blocks]) -> DiffractionFit:
        # With the samples about the places of LEDs found there.
        own, places = near.place.own.copy(), shots.centre_px.copy()
        places[index[index >= 0]] += own[index >= 0][:, :2]
        own[..., :2] = 0.0
        moved = replace(shots, centre_px=places)
        about = replace(problem, samples=gather(moved, geometry, chosen))
        return _refine(about, moved, near.place.theta, own, rules, near.iterations)

    fit = refined(begun.end)
    for begin in (lambda best: _begun_again(best, rules), lambda _: refined(approach_without_error(problem, rules))):
        if not far_from_prior(fit.theta, problem.prior):
            break
        other = begin(fit)
        fit = replace(min(fit, other, key=_unlikely), iterations=fit.iterations + other.iterations)
    if not problem.evaluator.interference:
        return fit
    phase = phase_evidence(fit)
    if phase.best is not phase.tried[0]:
        alone = replace(problem.evaluator, interference=False)
        # Samples of the fit hold corrections of interference.
        averaged = DiffractionProblem(gather(fit.shots, geometry, chosen), alone, problem.prior)
        fit = _refine(averaged, fit.shots, fit.theta, fit.solution.place.own, rules, 0)
    return replace(fit, phase=phase)


def _begun_again(fit: DiffractionFit, rules: PsfRules) -> DiffractionFit:
    """Begin at a minimum again, with the prior's footprint, whose place is held at first."""
    held, theta = with_place_held(fit.problem, fit.theta)
    near = _refine(held, fit.shots, theta, fit.solution.place.own, rules, 0)
    freed, own = replace(near.problem, held=None), near.solution.place.own
    return _refine(freed, fit.shots, near.theta, own, rules, near.iterations)


def _unlikely(fit: DiffractionFit) -> float:
    """Return minus twice the logarithm of the likelihood of all samples, outliers too, and of the prior."""
    place = fit.solution.place
    samples = fit.problem.samples.weighed(fit.model_error, place.light, place.own[..., 5:])
    variances = float(-np.log(samples.weight[samples.weight > 0]).sum())
    return replace(fit.problem, samples=samples).equations_at(place).cost + variances


def _refine(
    problem: DiffractionProblem, shots: Shots, theta: Theta, own: Own, rules: PsfRules, iterations: int
) -> DiffractionFit:
    """Go from near the minimum to the maximum of the likelihood.

    The last round moves nothing by a tenth of a sigma. Descents go to a hundredth of chi-squared once weights stay.
    """
    whole, enough, damping, model_error = None, 1.0, 1e6, 0.0
    problem = problem.about(theta, own)
    place = problem.at(theta, own)
    for _ in range(30):
        place = problem.with_dropped_begun_again(place, model_error)
        # Weights at the model's light, with the model error of the residuals, and without outliers.
        samples, light, background = problem.samples, place.light, place.own[..., 5:]
        seen, level = samples.known > 0, place.level
        of_samples = samples.rate - level, samples.sensor_variance(level), left_out(light * seen, 1.0)
        residual, variance, unit = (part[seen] for part in of_samples)
        model_error = estimate_model_error(residual, variance, unit, problem.unknowns)
        problem = replace(problem, samples=samples.weighed(model_error, light, background))
        kept, found = without_outliers(problem.samples, problem.errors(place), rules)
        problem = replace(problem, samples=kept)
        solution = minimise(problem, place, solver_rules(enough, rules.iterations - iterations, damping))
        iterations += solution.iterations
        change = solution.place.theta - place.theta
        moved = float(np.sqrt(change @ solution.equations.marginal()[0] @ change))
        LOG.debug("psf: model error %.3g, moved by %.3g sigma", model_error, moved)
        # Overlaps are large, and a fit that has ended does not need them.
        ended = replace(problem, samples=problem.samples.without_overlaps())
        fit = DiffractionFit(ended, solution, shots, model_error, found, iterations)
        # Derivatives are those of a place nearby: a descent may stop where they are not those of the cost, and the next
        # one goes on with new ones. Otherwise, and without iterations left, the round before counts: it has ended, with
        # weights of a slightly different model.
        if not solution.converged and (moved < 0.1 or iterations >= rules.iterations):
            return whole or fit
        if enough < 1.0 and moved < 0.1:
            return fit
        # So near, a step that does not succeed shows the end of what the derivatives can tell.
        place, (enough, damping) = solution.place, (1e-2, 1.0) if moved < 1.0 else (1.0, 1e6)
        whole = fit if solution.converged else whole
        # A change of less than a sigma is small enough for the interference set up before, of five for its derivatives.
        if moved >= 1.0:
            problem = problem.about(place.theta, place.own, moved < 5.0)
        if moved >= 1.0 or not solution.converged:
            place = problem.at(place.theta, place.own)
    # Weights that go on to change the parameters give no minimum.
    return replace(fit, solution=replace(fit.solution, converged=False))


def without_outliers(samples: Samples, z: Light, rules: PsfRules) -> tuple[Samples, tuple[Outliers, ...]]:
    """Return samples in which outliers have no weight, and a list of these: pictures, then samples of the others.

    In a picture that fits much worse than the others something moved, flickered or was in the way. It needs its own
    rule in addition to the engine's rule of single samples. ``z`` is data less expectation in units of sigma.
    """
    weight, index = samples.weight, samples.index
    used, real = weight > 0, index >= 0
    # Residuals are bounded, so that one cosmic hit does not make its picture an outlier.
    square = (np.minimum(z**2, HUBER.sigma**2) * used).sum(axis=-1) / np.maximum(used.sum(axis=-1), 1)
    worst = rules.picture_times * max(float(np.median(square[real])), 1.0)
    moved = real & (square > worst) & (real.sum() >= 4)
    rule = OutlierRule("samples")
    off = rule.off(z, used & ~moved[..., None])
    pictures = (f"picture {index[at]} at position {at[0]}" for at in zip(*np.nonzero(moved), strict=True))
    places = zip(*np.nonzero(off), strict=True)
    named = (f"picture {index[at[:2]]} at position {at[0]}, {z[at]:+.0f} sigma" for at in places)
    why = f"pictures whose mean squared residual is over {rules.picture_times:g} times the median picture's"
    kept = replace(samples, weight=weight * ~(off | moved[..., None]))
    return kept, (*outliers(why, pictures), *rule.listed(named))


def phase_evidence(fit: DiffractionFit) -> Choice[tuple[float, float]]:
    """Compare a fit with interference to the same fit without it, to second order about the fit."""
    problem, place, here = fit.problem, fit.solution.place, fit.solution.equations
    samples, changes = problem.samples, ("correction", "by_overlaps")
    none = replace(samples, **{name: np.zeros_like(getattr(samples, name)) for name in changes})
    averaged = replace(problem, samples=none, evaluator=replace(problem.evaluator, interference=False))
    change = place.light - averaged.at(place.theta, place.own, place).light
    in_sigma = change * np.sqrt(samples.weight)
    score, alone = float((in_sigma * problem.errors(place)).sum()), float((in_sigma**2).sum())
    # Residuals change by so small a part of the phase's light that their outliers stay the same.
    part = 1e-3
    there = replace(problem, samples=replace(samples, rate=samples.rate + part * change)).equations_at(place)
    shared, own = (there.right - here.right) / part, (there.own_right - here.own_right) / part
    # Residuals that the other parameters can compensate hold no information on the strength.
    information = max(alone - replace(here, right=shared, own_right=own).step(0.0).gain, 1e-12)
    found, unknowns = (1.0 + score / information, information**-0.5), problem.unknowns
    fewer, worse = unknowns - (FOOTPRINT.stop - FOOTPRINT.start), here.cost + information * (2.0 * found[0] - 1.0)
    orders = (("with the wire's phase", unknowns, here.cost), ("averaged over the phase", fewer, worse))
    return choose(
        Attempt(f"diffraction {n} (BIC)", k, bic(cost, float(k), here.samples), found) for n, k, cost in orders
    )


def pattern_p_value(samples: Samples, z: Light) -> float:
    """Return the probability that noise alone makes residuals of a position's pictures at least as similar.

    Each picture has its own noise, and samples the kernel at its own fraction of a pixel. Residuals of one colour at
    the same place of the kernel, within a pixel, are uncorrelated between two pictures unless the model is wrong there.
    The mean of their products, in units of its standard error, is normal. Means of groups (``engine.misfit``) also hold
    squares, which are no evidence and hide the common part of two pictures.
    ``z`` is data less expectation, in units of sigma.
    """
    z = np.clip(z, -HUBER.sigma, HUBER.sigma)
    position, shot = (number[..., None] for number in np.ogrid[: len(z), : z.shape[1]])
    place = np.broadcast_to(position, z.shape), *np.moveaxis(np.floor(samples.points), -1, 0)
    cells = np.stack([*place, samples.colour.argmax(axis=-1)], axis=-1).reshape(-1, 4)
    number = np.unique(cells, axis=0, return_inverse=True)[1].reshape(z.shape)
    pair = (number * z.shape[1] + shot).ravel()
    sums, squares = (np.bincount(pair, part.ravel(), (number.max() + 1) * z.shape[1]) for part in (z, z**2))
    # Only pairs of different pictures count.
    by_cell = (part.reshape(-1, z.shape[1]) for part in (sums, squares))
    total, variance = (float((part.sum(axis=1) ** 2 - (part**2).sum(axis=1)).sum()) / 2.0 for part in by_cell)
    return float(ndtr(-total / np.sqrt(variance))) if variance > 0 else 1.0
