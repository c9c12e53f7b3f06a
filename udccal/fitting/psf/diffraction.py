"""Fit of diffraction to LED pictures: maximum likelihood with the sensor's noise and a model error that residuals tell.

Rounds of a descent with fixed weights; between them the weights follow the model, and outliers go.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, final

import numpy as np
from jaxtyping import Float

from udccal.fitting.engine.gaussian import Prior, scaled_inverse
from udccal.fitting.engine.iteration_log import LOG
from udccal.fitting.engine.least_squares import Blocks, Solution, SolverRules, minimise
from udccal.fitting.engine.misfit import clustered_cov
from udccal.fitting.engine.orders import Attempt, Choice, bic, choose
from udccal.fitting.psf.data import Shots
from udccal.fitting.psf.kernel import FOOTPRINT, Evaluator, fit_lattice
from udccal.fitting.psf.problem import DiffractionProblem, Place
from udccal.fitting.psf.samples import Block, blocks, choose_samples, stands_for, start_own
from udccal.fitting.psf.start import PsfRules
from udccal.fitting.psf.weights import (
    estimate_model_error,
    left_out,
    pattern_p_value,
    sensor_variance,
    weighed,
    without_outliers,
)
from udccal.models.diffraction import Diffraction
from udccal.models.geometry import Geometry
from udccal.result import Outliers

# Converged near the minimum: by the part of the cost that a step would gain. Then by what it would gain in units of the
# reduced chi-squared: in rounds after which the weights hardly change anything, and in the others.
_ROUGHLY, _FULLY, _NEARLY = 1e-3, 1e-2, 1.0
# In sigma: a round that moves every parameter by less is the last; the weights are about those of the end.
_STILL, _SETTLED = 0.1, 1.0
# Derivatives that are themselves sums over a lattice promise a little for ever; see ``SolverRules.stalled_gain``.
_STALLED: Final = 0.05
# Residuals are moved by this part of the phase's light: too little to change which of them are outliers.
_TRIED: Final = 1e-3


@final
@dataclass(frozen=True)
class DiffractionFit:
    """What was found.

    Attributes:
        problem, solution: the equations, and where they ended.
        shots: what was fitted, at the places that the blocks are about.
        model_error: as a fraction of the peak, see ``psf.weights``; 0 where the residuals are noise.
        outliers: what was left out.
        iterations: of all descents together.
        phase: strength of the wire's phase in the kernel, its sigma, and both orders; None where no wire was seen.
    """

    problem: DiffractionProblem
    solution: Solution[Place, Blocks]
    shots: Shots
    model_error: float
    outliers: tuple[Outliers, ...]
    iterations: int
    phase: PhaseEvidence | None = None

    @property
    def theta(self) -> Float[np.ndarray, " p"]:
        """The shared parameters."""
        return self.solution.place.theta

    @property
    def converged(self) -> bool:
        """Whether a minimum was reached."""
        return self.solution.converged and bool(np.isfinite(self.theta).all() and np.isfinite(self.noise_cov).all())

    @property
    def noise_cov(self) -> Float[np.ndarray, "p p"]:
        """Covariance of the shared parameters, the model error taken as independent from sample to sample."""
        return self.solution.equations.cov()

    def cov(self) -> Float[np.ndarray, "p p"]:
        """Covariance of the shared parameters.

        What the model leaves out is alike in all samples of a position, so that it averages out over positions only.
        """
        if self.model_error == 0.0:
            return self.noise_cov
        alone = [position.marginal() for position in self.problem.by_position(self.solution.place)]
        return clustered_cov(self.noise_cov, np.stack([a[1] for a in alone]), np.stack([a[0] for a in alone]))

    @property
    def chi2_dof(self) -> float:
        """Reduced chi-squared, with that model error."""
        dof = max(self.problem.samples - self.problem.unknowns, 1)
        return (self.solution.equations.cost - self.problem.prior.cost(self.theta)) / dof

    def pattern_p(self) -> float:
        """How likely such a pattern in the residuals is by chance; see ``psf.weights``."""
        return pattern_p_value(self.problem.blocks, self.errors())

    def errors(self) -> list[Float[np.ndarray, "shots n"]]:
        """Data less expectation in units of sigma, position by position."""
        return self.problem.errors(self.solution.place, self.problem.light_at(self.solution.place))


def fit_diffraction(
    shots: Shots, geometry: Geometry, start: Diffraction, prior: Prior, rules: PsfRules, wire_shows: bool
) -> DiffractionFit:
    """Fit the numbers of diffraction: near the minimum, then to it at the places found there.

    Args:
        shots: what to fit, positions numbered without gaps.
        geometry: where pixels look.
        start: its nodes of the spectra are kept.
        prior: of the parameters of ``kernel.pack``; its mean is the start.
        rules: see there.
        wire_shows: whether the footprint's place on the rows is known; it is then tested whether the data show it.
    """
    chosen = choose_samples(shots, rules, rules.far_share)
    evaluator = Evaluator(np.asarray(start.wavelengths_nm), fit_lattice(rules.close(shots.half)), wire_shows)
    problem = DiffractionProblem(blocks(shots, geometry, chosen), evaluator, prior).with_overlaps(prior.mean)
    near = _approach(problem, rules)
    own = near.place.own.copy()
    index = np.stack([np.asarray(block.index) for block in problem.blocks])
    places = shots.centre_px.copy()
    places[index[index >= 0]] += own[index >= 0][:, :2]
    shots = replace(shots, centre_px=places)
    own[..., :2] = 0.0
    problem = replace(problem, blocks=blocks(shots, geometry, chosen))
    fit = _refine(problem, shots, Place(near.place.theta, own), rules, near.iterations)
    if not wire_shows:
        return fit
    evidence = phase_evidence(fit)
    if not evidence.wanted:
        averaged = replace(problem, evaluator=Evaluator(evaluator.wavelengths_nm, evaluator.lattice, False))
        fit = _refine(averaged, shots, fit.solution.place, rules, 0)
    return replace(fit, phase=evidence)


def _approach(problem: DiffractionProblem, rules: PsfRules) -> Solution[Place, Blocks]:
    """From the prior's mean to about the minimum, with weights that the data give."""
    problem = replace(problem, blocks=tuple(weighed(b, rules.first_model_error) for b in problem.blocks))
    theta = problem.prior.mean
    own = [start_own(problem.evaluator, block, problem.coefficients(theta, block)) for block in problem.blocks]
    return minimise(problem, Place(theta.copy(), np.stack(own)), _solver(_ROUGHLY * problem.samples, rules.iterations))


def _refine(
    problem: DiffractionProblem, shots: Shots, place: Place, rules: PsfRules, iterations: int
) -> DiffractionFit:
    """From about the minimum to the maximum of the likelihood."""
    whole, enough = None, _NEARLY
    for _ in range(rules.rounds):
        problem, model_error, found = _reweighed(problem.with_corrections(place), place, rules)
        solution = minimise(problem, place, _solver(enough, rules.iterations - iterations))
        iterations += solution.iterations
        change = solution.place.theta - place.theta
        moved = float(np.sqrt(change @ solution.equations.marginal()[0] @ change))
        LOG.debug("psf: model error %.3g, moved by %.3g sigma", model_error, moved)
        fit = DiffractionFit(problem, solution, shots, model_error, found, iterations)
        # Out of iterations: the round before, whose weights are those of a model not quite this one, has an end.
        if not solution.converged:
            return whole or fit
        whole, place, last = fit, solution.place, enough == _FULLY and moved < _STILL
        if last:
            break
        enough = _FULLY if moved < _SETTLED else _NEARLY
    assert whole is not None  # there is a first round
    return whole


def _solver(enough: float, iterations: int) -> SolverRules:
    return SolverRules(enough, _STALLED, iterations=iterations, first_damping=1e-2, most_damping=1e6)


def _reweighed(
    problem: DiffractionProblem, place: Place, rules: PsfRules
) -> tuple[DiffractionProblem, float, tuple[Outliers, ...]]:
    """Weights at the model's light, with the model error that the residuals tell, and without outliers."""
    lights, parts = problem.light_at(place), []
    for block, own, light in zip(problem.blocks, place.own, lights, strict=True):
        seen, level = np.asarray(block.known) > 0, light + own[:, 5:]
        of_sample = (np.asarray(block.rate) - level, sensor_variance(block, level), left_out(light * seen, 1.0))
        parts.append([one[seen] for one in of_sample])
    residual, variance, share = (np.concatenate(column) for column in zip(*parts, strict=True))
    model_error = estimate_model_error(residual, variance, share, problem.unknowns)
    triples = zip(problem.blocks, lights, place.own, strict=True)
    problem = replace(problem, blocks=tuple(weighed(b, model_error, light, own[:, 5]) for b, light, own in triples))
    kept, found = without_outliers(problem.blocks, problem.errors(place, lights), rules)
    return replace(problem, blocks=kept), model_error, found


@final
@dataclass(frozen=True)
class PhaseEvidence:
    """Whether the data show the wire's phase in the kernel.

    Attributes:
        strength: of what the phase changes, estimated beside all other parameters: 1 where the footprint lies where the
            wire has it, 0 where the kernel knows nothing of it.
        sigma: of the strength.
        choice: with the phase or averaged over it, by BIC; the fits are their strengths.
    """

    strength: float
    sigma: float
    choice: Choice[float]

    @property
    def wanted(self) -> bool:
        """Whether the kernel with the wire's phase is the better one."""
        return self.choice.best.fit > 0


def phase_evidence(fit: DiffractionFit) -> PhaseEvidence:
    """Compare a fit with interference to the same without, to second order about the fit."""
    problem, place, here = fit.problem, fit.solution.place, fit.solution.equations
    plain = replace(problem, blocks=tuple(_without_interference(block) for block in problem.blocks))
    lights = problem.light_at(place)
    by_phase = [light - without for light, without in zip(lights, plain.light_at(place), strict=True)]
    moved, score, alone = [], 0.0, 0.0
    for block, change, z in zip(problem.blocks, by_phase, problem.errors(place, lights), strict=True):
        in_sigma = change * np.sqrt(np.asarray(block.weight))
        score += float((in_sigma * z).sum())
        alone += float((in_sigma**2).sum())
        moved.append(replace(block, rate=np.asarray(block.rate) + _TRIED * change))
    there = replace(problem, blocks=tuple(moved)).equations_at(place)
    shared, own = (there.right - here.right) / _TRIED, (there.own_right - here.own_right) / _TRIED
    # What the other parameters can make up for is no information on the strength.
    information = max(alone - replace(here, right=shared, own_right=own).step(0.0).gain, 1e-12)
    strength, unknowns = 1.0 + score / information, problem.unknowns
    fewer = unknowns - (FOOTPRINT.stop - FOOTPRINT.start)
    worse = here.cost + information * (2.0 * strength - 1.0)
    orders = (("with the wire's phase", unknowns, here.cost, 1.0), ("averaged over the phase", fewer, worse, 0.0))
    tried = [Attempt(f"diffraction {n} (BIC)", k, bic(cost, float(k), here.samples), fit) for n, k, cost, fit in orders]
    return PhaseEvidence(strength, information**-0.5, choose(tried))


def _without_interference(block: Block) -> Block:
    parts = {name: np.zeros_like(getattr(block, name)) for name in ("correction", "by_overlaps", "overlaps")}
    return replace(block, **parts)


def efficiency(fit: DiffractionFit, rules: PsfRules, available: int, reported: int) -> float:
    """Variance that all samples of all pictures would leave over the variance of the fit, mean of its first numbers.

    Args:
        fit: the samples drawn away from the peak stand for all of them there.
        rules: how many were drawn.
        available: pictures there are.
        reported: so many numbers are looked at.
    """
    count = stands_for(fit.shots, rules)
    weighed_up = (replace(b, weight=np.asarray(b.weight) * count[np.asarray(b.index)]) for b in fit.problem.blocks)
    positions = replace(fit.problem, blocks=tuple(weighed_up)).by_position(fit.solution.place)
    information = sum(position.marginal()[0] for position in positions) * available / fit.shots.count
    best = scaled_inverse(fit.problem.prior.precision + information)
    return float(np.mean(np.diag(best)[:reported] / np.diag(fit.noise_cov)[:reported]))


def kernel_sigma(fit: DiffractionFit, cov: Float[np.ndarray, "p p"]) -> float:
    """Relative L2 sigma of the kernel at the first position, in all colours.

    At weights that make every sample of the kernel count alike, the equations hold the sum of its squared derivatives.
    """
    block, place = fit.problem.blocks[0], fit.solution.place
    even = np.asarray(block.colour) / np.maximum(np.asarray(block.colour).sum(axis=1, keepdims=True), 1)
    unit = np.tile([0.0, 0.0, 1.0, 1.0, 1.0, 0.0], (len(even), 1)) + place.own[0] * [1, 1, 0, 0, 0, 0]
    one = replace(fit.problem, blocks=(replace(block, weight=even.sum(axis=-1)),))
    there = Place(place.theta, unit[None])
    (light,) = one.light_at(there)
    (sums,) = replace(one, blocks=(replace(one.blocks[0], rate=light),)).by_position(there)
    return float(np.sqrt(max(float((sums.shared * cov).sum()), 0.0) / float((even.sum(axis=-1) * light**2).sum())))
