"""The backscatter fit at its limit: pictures whose light follows the model itself, on a small sensor.

Truths are drawn from the fit's own prior (its tolerances), light from ``udccal.models.backscatter``, noise as shot
noise of whole electrons and normal read noise. The bound is that of the likelihood with mask and dark profiled, the
prior's information included; see ``Ideal``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from tests.benchmarks.efficiency.trials import Trials
from tests.scenes.backscatter import (
    PICTURES,
    RULES,
    World,
    noise_free,
    panel_pictures,
    predicted_light,
    shots_of,
    small_rig,
    world,
)
from udccal.fitting.backscatter.data import BackscatterData
from udccal.fitting.backscatter.fit import result_of
from udccal.fitting.backscatter.model import grid_rays
from udccal.fitting.backscatter.parameters import (
    NAMES,
    TWO_PLANES,
    footprint_per_pupil,
    linear_of,
    linear_slope,
    most_probable,
    prior_of,
)
from udccal.fitting.backscatter.posterior import TermAt, moments_along_reflection
from udccal.fitting.backscatter.search import search
from udccal.fitting.backscatter.solve import Problem
from udccal.fitting.engine.gaussian import Posterior
from udccal.models.backscatter import Backscatter
from udccal.numerics import in_float64

REALISATIONS = 400
_PLACES = np.array([40, 95, 140, 190])


@dataclass(frozen=True)
class Ideal:
    """Information in the pictures: truth and bounds, from shots without noise that have the weights of noisy ones.

    Attributes:
        posterior: the truth, with the Cramér–Rao bound on the parameters' covariance, the prior's information included.
        sigma: of the reported values: how wide noise-free pictures leave the posterior. The mean of its square over the
            prior is the least mean squared error of any estimate; where sigma is small it is the Cramér–Rao bound.
    """

    posterior: Posterior[Backscatter]
    sigma: Float[np.ndarray, "18"]


@in_float64
def ideal_of(of: World, expected: BackscatterData, flat: np.ndarray, template: Backscatter) -> Ideal:
    """The best that the positions with these flat indices allow."""
    prior, free, theta = prior_of(of.rig), TWO_PLANES.free, linear_of(of.x)
    rays = grid_rays(template.geometry, expected.shots.rate.shape[2:], template.step, flat)
    seen = expected.shots.at(flat)
    weight = seen.weights(seen.rate, seen.rate[0], 0.0, seen.usable)
    problem = Problem(template, seen, expected.pictures, rays, flat, prior, of.x, RULES)
    errors_at = problem.errors_at(weight)
    jacobian = errors_at(of.x)[1] / linear_slope(of.x)
    cov = np.linalg.inv(jacobian.T @ jacobian + np.diag((prior.sigma * linear_slope(of.x)) ** -2.0))
    used = np.ones(len(seen.rate), dtype=bool)
    # The prior draws what is hardly seen towards its mean.
    found = most_probable(errors_at, of.x, free, prior)
    sigma = np.sqrt(np.diag(moments_along_reflection(errors_at, found, free, prior).cov))
    sigma[2] /= footprint_per_pupil(of.rig)
    return Ideal(TermAt(template, expected, used, 0.0, theta).posterior(cov), sigma)


@dataclass(frozen=True)
class _One:
    """One realisation: errors, sigmas and bounds of the parameters and of predicted light."""

    parameters: Float[np.ndarray, "3 18"]
    light: Float[np.ndarray, "3 n"]


def realisation(seed: int) -> _One:
    """Draw a rig and its pictures, fit them, predict a new picture."""
    rng = np.random.default_rng([seed, 0xBAC])
    of = world(rng, small_rig())
    pictures = panel_pictures(of.rig, 100 * seed, PICTURES + 1)
    new, pictures = pictures[-1:], pictures[:-1]
    data = shots_of(of, rng, pictures)
    # The order is known here; whether it is found is another question.
    found = search(Problem.of(data, of.term.geometry, of.rig, RULES), (TWO_PLANES,))
    result = result_of(found, data, of.rig, [])
    values = np.array([[e.value, e.sigma] for e in result.estimates]).T
    expected = noise_free(data, of, pictures)
    ideal = ideal_of(of, expected, found.problem.flat, of.term)
    model_error = found.model_error
    predicted = predicted_light(result.term, result, model_error, of.rig, new, _PLACES)
    limit = predicted_light(of.term, ideal.posterior, 0.0, of.rig, new, _PLACES)
    light = np.stack([predicted.rate - limit.rate, predicted.sigma, limit.sigma]).reshape(3, -1)
    return _One(np.stack([values[0] - of.values, values[1], ideal.sigma]), light)


def trials(share: float) -> list[Trials]:
    """Every reported parameter, and the light of a new picture at some positions."""
    found = [realisation(seed) for seed in range(max(int(REALISATIONS * share), 3))]
    parameters = np.stack([one.parameters for one in found])
    light = np.stack([one.light for one in found])
    names = [f"backscatter/{name}" for name in NAMES]

    def trials_of(name: str, of: Float[np.ndarray, "realisations 3 places"]) -> Trials:
        # The fit looks at some places of the sensor; what all would tell has not been computed.
        return Trials(name, of[:, 0], of[:, 1], of[:, 2], bound_of_all=np.full(of[:, 0].shape, np.nan))

    of_names = [trials_of(name, parameters[:, :, [k]]) for k, name in enumerate(names)]
    return [*of_names, trials_of("backscatter/light of a new picture", light)]
