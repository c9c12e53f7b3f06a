"""The backscatter fit at its limit: pictures whose light follows the model itself, on a small sensor.

Truths are drawn from the fit's own prior (its tolerances), light from ``udccal.models.backscatter``, noise as shot
noise of whole electrons and normal read noise. The bound is that of the likelihood with mask and dark profiled, the
prior's information included; see ``Ideal``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import numpy as np
from jaxtyping import Float

from tests.benchmarks.efficiency.trials import Trials
from udccal.displays.pictures import face_picture
from udccal.fitting.backscatter import BackscatterData, BackscatterRules
from udccal.fitting.backscatter.data import Binned, grid_rays, grid_step, visible_crop
from udccal.fitting.backscatter.fit import result_of
from udccal.fitting.backscatter.likelihood import Samples
from udccal.fitting.backscatter.orders import search
from udccal.fitting.backscatter.parameters import (
    NAMES,
    TWO_PLANES,
    Order,
    footprint_share,
    linear_of,
    linear_slope,
    prior_of,
    values_of,
    with_linear,
)
from udccal.fitting.backscatter.posterior import TermAt, moments_along_reflection, posterior_around
from udccal.fitting.backscatter.ratios import corners_of, window_for
from udccal.fitting.backscatter.solve import Problem, SampleErrors, most_probable
from udccal.fitting.engine.gaussian import Posterior
from udccal.fitting.nominal import nominal_backscatter, nominal_geometry
from udccal.models.backscatter import Backscatter, panel_response, response_grid
from udccal.numerics import in_float64
from udccal.result import FitResult
from udccal.rig import Nominal, RigDescription, load_rig

REALISATIONS = 400
POSITIONS = 24
RULES = BackscatterRules(positions=POSITIONS)
PICTURES = 8
EXPOSURE_S = 0.05
_READ_E = 2.5
# Of samples and frames behind a bin's average: 16 x 16 pixels, four frames.
_SAMPLES = 1024
_PLACES = np.array([40, 95, 140, 190])


def small_rig() -> RigDescription:
    """The reduced mirror with few, large pixels: the field of the full one on 16 x 12 bins."""
    rig = load_rig("lg55-reduced")
    camera = rig.camera.model_copy(update={"columns": 96, "rows": 72, "pitch_um": 46.0})
    panel = rig.panel.model_copy(
        update={"columns": 400, "rows": 300, "pitch_mm": Nominal(value=rig.panel.pitch_mm.value, tolerance=0.0)}
    )
    mounting = rig.mounting.model_copy(
        update={"panel_x_px": Nominal(value=200.0, tolerance=1.0), "panel_y_px": Nominal(value=150.0, tolerance=1.0)}
    )
    return rig.model_copy(update={"camera": camera, "panel": panel, "mounting": mounting})


@dataclass(frozen=True)
class World:
    """A rig whose light follows the model, with its truth in the solver's coordinates."""

    rig: RigDescription
    term: Backscatter
    x: Float[np.ndarray, "18"]

    @property
    def values(self) -> Float[np.ndarray, "18"]:
        """The truth as the fit reports it."""
        values = values_of(self.x)
        values[2] /= footprint_share(self.rig)
        return values


@in_float64
def world(rng: np.random.Generator, rig: RigDescription, order: Order = TWO_PLANES, white: float = 2e4) -> World:
    """Draw a truth of an order from the prior; ``white`` is the light of white in e-/s per sample."""
    prior = prior_of(rig)
    x = order.start(prior.mean + prior.sigma * rng.normal(size=18), prior)
    return world_at(x, rig, white * rng.uniform(0.5, 1.0, (3, 1, 1)))


@in_float64
def world_at(x: Float[np.ndarray, "18"], rig: RigDescription, white: Float[np.ndarray, "3 1 1"]) -> World:
    """The rig with these parameters; white falls off towards the corners."""
    step = grid_step(rig)
    rows, columns = rig.camera.rows // step, rig.camera.columns // step
    v, u = np.mgrid[-1 : 1 : 1j * rows, -1 : 1 : 1j * columns]
    mask = white * (1 - 0.3 * (u**2 + v**2) / 2)
    template = nominal_backscatter(nominal_geometry(rig), rig, mask, step, window=1)
    rays, theta = grid_rays(template.geometry, (rows, columns), step, np.arange(rows * columns)), linear_of(x)
    term = with_linear(replace(template, window=window_for(template, theta, rays, 1.0)), jax.numpy.asarray(theta))
    return World(rig, jax.tree.map(np.asarray, term), x)


def panel_pictures(rig: RigDescription, first: int, count: int) -> list[np.ndarray]:
    """Face-like pictures."""
    return [face_picture(first + k, rig.panel.columns, rig.panel.rows) for k in range(count)]


@in_float64
def clean_light(of: World, pictures: list[np.ndarray]) -> list[Float[np.ndarray, "3 grid_rows grid_columns"]]:
    """Rates without noise."""
    response = panel_response(of.term, of.rig.panel.rows, of.rig.panel.columns)
    return [np.asarray(response_grid(response, picture)) for picture in pictures]


def measured(
    rate: Float[np.ndarray, "3 a b"], rng: np.random.Generator, exposure_s: float = EXPOSURE_S, read_e: float = _READ_E
) -> Binned:
    """One shot in bins of ``_SAMPLES`` samples (frames included): whole electrons, then read noise."""
    shot = np.full_like(rate, 1 / (exposure_s * _SAMPLES))
    rest = np.full_like(rate, read_e**2 / exposure_s**2 / _SAMPLES)
    light = rng.poisson(np.maximum(rate, 0.0) / shot) * shot + rng.normal(size=rate.shape) * np.sqrt(rest)
    parts = (light, shot, rest, np.zeros(rate.shape, dtype=bool))
    return Binned(*(part[None] for part in parts), np.array([exposure_s]), np.array([np.nan]))


def shots_of(
    of: World, rng: np.random.Generator, pictures: list[np.ndarray], exposure_s: float = EXPOSURE_S
) -> BackscatterData:
    """White, dark and pictures with noise."""
    crop = visible_crop(of.term.geometry, of.rig)
    panel = of.rig.panel
    white = np.full((panel.rows, panel.columns, 3), 255, np.uint8)
    rates = clean_light(of, [white, *pictures])
    shots = Binned.joined([measured(rate, rng, exposure_s) for rate in (*rates, np.zeros_like(rates[0]))])
    shown = np.stack([crop.of(picture) for picture in pictures])
    return BackscatterData(shots, shown, crop, tuple(f"picture_{k}" for k in range(len(pictures))))


def noise_free(data: BackscatterData, of: World, pictures: list[np.ndarray]) -> BackscatterData:
    """The same shots with the light that they have on average."""
    panel = of.rig.panel
    white = np.full((panel.rows, panel.columns, 3), 255, np.uint8)
    rates = clean_light(of, [white, *pictures])
    return replace(data, shots=replace(data.shots, rate=np.stack([*rates, np.zeros_like(rates[0])])))


@dataclass(frozen=True)
class Light:
    """Predicted rates in e-/s at positions, by camera colour, and one sigma of each."""

    rate: Float[np.ndarray, "pictures 3 n"]
    sigma: Float[np.ndarray, "pictures 3 n"]


@in_float64
def predicted_light(
    term: Backscatter,
    posterior: FitResult[Backscatter] | Posterior[Backscatter],
    model_error: float,
    rig: RigDescription,
    pictures: list[np.ndarray],
    flat: np.ndarray,
) -> Light:
    """Light of new pictures at grid positions, as sure as the term is, and as its model is of any new picture."""

    def light(one: Backscatter) -> np.ndarray:
        response = panel_response(one, rig.panel.rows, rig.panel.columns)
        return np.stack([np.asarray(response_grid(response, shown)).reshape(3, -1)[:, flat] for shown in pictures])

    of_model = model_error * np.asarray(term.mask).reshape(3, -1)[:, flat]
    return Light(light(term), np.hypot(posterior.sigma_of(light), of_model))


@dataclass(frozen=True)
class Ideal:
    """What the pictures tell at best: truth and bounds, from shots without noise that are weighed as if they had it.

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
    samples = Samples.at(expected, rays, flat, expected.pictures)
    weight = samples.weights(samples.light, samples.light[0], 0.0, samples.usable)
    errors_at = SampleErrors.of(template, samples, weight, corners_of(template, theta, rays))
    jacobian = errors_at(of.x)[1] / linear_slope(of.x)
    cov = np.linalg.inv(jacobian.T @ jacobian + np.diag((prior.sigma * linear_slope(of.x)) ** -2.0))
    used = np.ones(len(samples.light), dtype=bool)
    # The prior draws what is hardly seen towards its mean.
    found = most_probable(errors_at, of.x, free, prior)
    sigma = np.sqrt(np.diag(moments_along_reflection(errors_at, found, free, prior, RULES).cov))
    sigma[2] /= footprint_share(of.rig)
    return Ideal(posterior_around(TermAt(template, expected, used, 0.0, theta), cov), sigma)


@dataclass(frozen=True)
class _One:
    """One realisation: errors, stated sigmas and bounds of the parameters, and the same of predicted light."""

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
    ideal = ideal_of(of, expected, found.problem.flat, found.problem.template)
    model_error = found.state.model_error
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
    of_names = [Trials(name, *(parameters[:, part, k : k + 1] for part in range(3))) for k, name in enumerate(names)]
    return [*of_names, Trials("backscatter/light of a new picture", light[:, 0], light[:, 1], light[:, 2])]
