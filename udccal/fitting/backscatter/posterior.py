"""How sure a backscatter fit is: of its values, integrated where that matters, and of the whole term, mask included.

The likelihood is close to a parabola in the solver's coordinates but for one of them: once nearly all light comes by
way of the glass, or nearly none does, more of the same changes nothing, and the logarithm of the reflection runs away.
Along it the posterior is worked out at equal steps, at each of which all other parameters are normal: integrated over
by Laplace's method (Tierney and Kadane, Journal of the American Statistical Association 81, 1986).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import final

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from udccal.fitting.backscatter.data import BackscatterData, grid_rays
from udccal.fitting.backscatter.likelihood import Profile, Samples, of_all_shots
from udccal.fitting.backscatter.orders import Found
from udccal.fitting.backscatter.parameters import REFLECTION, Moments, Vector, linear_of, linear_slope, with_linear
from udccal.fitting.backscatter.ratios import Windows, corners_of, ratios, ratios_and_jacobian
from udccal.fitting.backscatter.rules import BackscatterRules
from udccal.fitting.backscatter.solve import ErrorsAt, MostProbable, SampleErrors, most_probable
from udccal.fitting.engine.gaussian import Posterior, Prior, square_root
from udccal.fitting.engine.orders import evidence
from udccal.models.backscatter import Backscatter
from udccal.numerics import in_float64

# Grid positions that are held in memory at a time: of light, and of its derivatives.
_CHUNK, _SMALL_CHUNK = 4096, 256
# Bins so far apart are never interpolated between.
_TILE = 4


def value_moments(found: Found, inflation: float) -> Moments:
    """Of the values by the chosen order; where other orders may be right, the covariance holds them, too.

    Their part is their own covariance and by how much they differ from the chosen one, by their probability (Hoeting et
    al., Statistical Science 14, 1999). ``inflation`` is of the noise's variance, where residuals have a pattern.
    """
    problem, fitted, free = found.problem, found.state.fitted, found.order.free
    weight, solved, rules = fitted.weight / np.sqrt(inflation), fitted.found, problem.rules
    errors_at = SampleErrors.of(problem.template, problem.samples, weight, fitted.corner)
    if inflation > 1:
        # The prior is as sure as before: only the pictures say less.
        solved = most_probable(errors_at, solved.x, free, problem.prior, rules.solver)
    own = moments_along_reflection(errors_at, solved, free, problem.prior, rules)
    cov = np.zeros_like(own.cov)
    for one, probability in zip(found.orders.tried, found.orders.probabilities, strict=True):
        part = own if one is found.orders.best else Moments.log_normal(one.fit.found.x, one.fit.found.cov)
        off = part.mean - own.mean
        cov += probability * (part.cov + np.outer(off, off))
    return Moments(own.mean, cov)


def moments_along_reflection(
    errors_at: ErrorsAt, solved: MostProbable, free: Bool[np.ndarray, "18"], prior: Prior, rules: BackscatterRules
) -> Moments:
    """Mean and covariance of the values around the most probable parameters.

    Args:
        errors_at: whitened errors and their Jacobian, as the solution was found with.
        solved: the most probable parameters.
        free: parameters that were fitted.
        prior: in the solver's coordinates.
        rules: how far along the reflection.
    """
    step = float(np.sqrt(max(solved.cov[REFLECTION, REFLECTION], 0.0)))
    if not free[REFLECTION] or step < rules.narrow or not solved.converged:
        return Moments.log_normal(solved.x, solved.cov)
    others = free & (np.arange(len(free)) != REFLECTION)

    def node(start: Vector) -> tuple[MostProbable, float]:
        """The others at this reflection, and the posterior's logarithm there."""
        held = most_probable(errors_at, start, others, prior, rules.solver)
        off = (start[REFLECTION] - prior.mean[REFLECTION]) / prior.sigma[REFLECTION]
        cov = held.cov[np.ix_(others, others)]
        return held, -0.5 * evidence(held.cost + float(off) ** 2, cov, prior.sigma[others])

    nodes = [node(solved.x)]
    middle, top = nodes[0]
    for sign in (1.0, -1.0):
        last, way = middle, sign * solved.cov[:, REFLECTION] / step
        for _ in range(rules.most_nodes):
            here, log = node(last.x + way)
            nodes.append((here, log))
            way, last = here.x - last.x, here
            # In squares of the value, to which its variance goes, values further up weigh more.
            ahead = 2 * max(float(here.x[REFLECTION] - middle.x[REFLECTION]), 0.0)
            if not log - top + ahead > rules.negligible:
                break
    # Equal steps: sums are integrals, to many digits for what falls off this smoothly.
    weights = np.exp([log - max(log for _, log in nodes) for _, log in nodes])
    return Moments.mixture([Moments.log_normal(one.x, one.cov) for one, _ in nodes], weights / weights.sum())


_with_linear = jax.jit(with_linear)


@final
@dataclass(frozen=True)
class TermAt:
    """The term as a function of its parameters (``linear_of``), and of ``_TILE`` squared numbers of the mask's noise.

    The mask is the best one for all shots, which know it better than white alone. It follows the parameters linearly.
    Bins that share one of the numbers are so far from each other that nothing interpolated sees two of them, and go up
    and down by chance, so that sums over the sensor are right on average.
    """

    template: Backscatter
    data: BackscatterData
    used: Bool[np.ndarray, " shots"]
    model_error: float
    theta: Vector

    @in_float64
    def __call__(self, parameters: Float[np.ndarray, " n"]) -> Backscatter:
        """The term, its mask never below 0."""
        theta, noise = parameters[: len(self.theta)], parameters[len(self.theta) :].reshape(_TILE, _TILE)
        mask, sigma = self._mask
        rows, columns = mask.shape[1:]
        mask = mask + sigma * np.tile(noise, (-(-rows // _TILE), -(-columns // _TILE)))[:rows, :columns]
        if (moved := theta - self.theta).any():
            mask = mask + np.einsum("k,kcij->cij", moved, self._mask_jacobian)
        with_parameters = _with_linear(self.template, theta)
        term = jax.tree.map(lambda leaf: np.asarray(leaf, dtype=np.float64), with_parameters)
        return replace(term, geometry=self.template.geometry, mask=np.maximum(mask, 0.0))

    @functools.cached_property
    def _mask(self) -> tuple[Float[np.ndarray, "3 a b"], Float[np.ndarray, "3 a b"]]:
        """Light of white over the whole grid, and one sigma of it, whose sign is drawn."""
        found = [self._best(flat) for flat in self._chunks(_CHUNK)]
        mask = np.concatenate([one.mask for one in found], axis=1)
        sigma = np.concatenate([np.maximum(one.information, 1e-30) for one in found], axis=1) ** -0.5
        sign = np.random.default_rng(0).choice([-1.0, 1.0], mask.shape)
        shape = self.data.shots.rate.shape[1:]
        return np.maximum(mask, 0.0).reshape(shape), (sign * sigma).reshape(shape)

    @functools.cached_property
    def _mask_jacobian(self) -> Float[np.ndarray, "18 3 a b"]:
        """How the mask follows the parameters: worked out for those who ask how sure the term is."""
        parts = []
        for flat in self._chunks(_SMALL_CHUNK):
            at = self._windows(flat)
            of_ratio = ratios_and_jacobian(self.template, self.theta, at, at.logs(self.data.pictures))[1]
            parts.append(self._best(flat).mask_jacobian(of_all_shots(of_ratio, 0.0)))
        return np.concatenate(parts, axis=2).reshape(-1, *self.data.shots.rate.shape[1:])

    def _chunks(self, size: int) -> list[Int[np.ndarray, " n"]]:
        count = self.data.shots.rate[0, 0].size
        return [np.arange(first, min(first + size, count)) for first in range(0, count, size)]

    def _windows(self, flat: Int[np.ndarray, " n"]) -> Windows:
        rays = grid_rays(self.template.geometry, self.data.shots.rate.shape[2:], self.template.step, flat)
        return Windows.at(self.template.window, rays, corners_of(self.template, self.theta, rays), self.data.pictures)

    def _best(self, flat: Int[np.ndarray, " n"]) -> Profile:
        """Mask and dark signal, once by weights of what was measured, then by those of the model."""
        at, shown = self._windows(flat), self.data.pictures
        samples = Samples.at(self.data, at.rays, flat, shown)
        samples = replace(samples, usable=samples.usable & self.used[:, None, None])
        ratio = of_all_shots(ratios(self.template, self.theta, at, shown), 1.0)
        best = Profile.of(ratio, samples, samples.first_weights())
        for _ in range(2):
            weight = samples.weights(best.mask * ratio, best.mask, self.model_error, samples.usable)
            best = Profile.of(ratio, samples, weight)
        return best


@in_float64
def term_posterior(
    template: Backscatter, data: BackscatterData, found: Found, inflation: float
) -> Posterior[Backscatter]:
    """Of the whole term: its parameters, the mask that follows them, the mask's own noise, and other orders.

    What the model leaves undescribed of a picture (``model_error_of_white``) is no error of the term and comes on top.

    Args:
        template: gives the window.
        data: all shots.
        found: the chosen order's fit, and the others.
        inflation: of the parameters' variance.
    """
    chosen, orders = found.state.fitted.found, found.orders
    theta, cov = linear_of(chosen.x), np.zeros_like(chosen.cov)
    for one, probability in zip(orders.tried, orders.probabilities, strict=True):
        own = one is orders.best
        fit = chosen if own else one.fit.found
        off, slope = linear_of(fit.x) - theta, linear_slope(fit.x)
        cov += probability * (fit.cov * np.outer(slope, slope) * (inflation if own else 1.0) + np.outer(off, off))
    return posterior_around(TermAt(template, data, ~found.bad_shots, found.state.model_error, theta), cov)


def posterior_around(term_at: TermAt, cov: Float[np.ndarray, "18 18"]) -> Posterior[Backscatter]:
    """With this covariance of the parameters, and the mask's noise."""
    count, noise = len(cov), _TILE**2
    factor = np.eye(count + noise)
    factor[:count, :count] = square_root(cov)
    return Posterior(np.concatenate([term_at.theta, np.zeros(noise)]), factor, term_at)
