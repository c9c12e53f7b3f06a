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
from udccal.fitting.backscatter.bins import Binned
from udccal.fitting.backscatter.data import PanelShots, grid_step, visible_crop
from udccal.fitting.backscatter.evidence import evidence, pictures_of, weights
from udccal.fitting.backscatter.fit import problem_of
from udccal.fitting.backscatter.light import Knowledge, grid_rays, predict_light
from udccal.fitting.backscatter.likelihood import errors_of
from udccal.fitting.backscatter.posterior import posterior_moments
from udccal.fitting.backscatter.report import known_from, told
from udccal.fitting.backscatter.select import choose
from udccal.fitting.backscatter.solve import corners_of, window_for
from udccal.fitting.backscatter.vector import (
    NAMES,
    TWO_PLANES,
    Order,
    footprint_share,
    prior_of,
    values_of,
    with_vector,
)
from udccal.fitting.nominal import nominal_backscatter, nominal_geometry
from udccal.fitting.solvers import most_probable
from udccal.models.backscatter import Backscatter, panel_response, response_grid
from udccal.numerics import in_float64
from udccal.rig import Nominal, RigDescription, load_rig

REALISATIONS = 400
POSITIONS = 24
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
    rays = grid_rays(template, np.arange(rows * columns))
    term = with_vector(replace(template, window=window_for(template, x, rays, 1.0)), jax.numpy.asarray(x))
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
    """A shot in bins of ``_SAMPLES`` samples (frames included): whole electrons, then read noise."""
    shot = np.full_like(rate, 1 / (exposure_s * _SAMPLES))
    rest = np.full_like(rate, read_e**2 / exposure_s**2 / _SAMPLES)
    light = rng.poisson(np.maximum(rate, 0.0) / shot) * shot + rng.normal(size=rate.shape) * np.sqrt(rest)
    return Binned(light, shot, rest, np.zeros(rate.shape, dtype=bool), exposure_s)


def shots_of(
    of: World, rng: np.random.Generator, pictures: list[np.ndarray], exposure_s: float = EXPOSURE_S
) -> PanelShots:
    """White, dark and pictures with noise."""
    crop = visible_crop(of.term.geometry, of.rig)
    panel = of.rig.panel
    white = np.full((panel.rows, panel.columns, 3), 255, np.uint8)
    rates = clean_light(of, [white, *pictures])
    seen = [measured(rate, rng, exposure_s) for rate in rates]
    dark = measured(np.zeros_like(rates[0]), rng, exposure_s)
    shown = np.stack([crop.of(picture) for picture in pictures])
    return PanelShots(seen[0], dark, tuple(seen[1:]), shown, crop, tuple(f"picture_{k}" for k in range(len(pictures))))


def noise_free(shots: PanelShots, of: World, pictures: list[np.ndarray]) -> PanelShots:
    """The same shots with the light that they have on average."""
    panel = of.rig.panel
    white = np.full((panel.rows, panel.columns, 3), 255, np.uint8)
    rates = clean_light(of, [white, *pictures])
    seen = tuple(replace(one, rate=rate) for one, rate in zip(shots.seen, rates[1:], strict=True))
    dark = replace(shots.dark, rate=np.zeros_like(rates[0]))
    return replace(shots, white=replace(shots.white, rate=rates[0]), dark=dark, seen=seen)


@dataclass(frozen=True)
class Ideal:
    """What the pictures tell at best: truth and bounds, from shots without noise that are weighed as if they had it.

    Attributes:
        knowledge: truth, with the Cramér–Rao bound on the covariance of the solver's coordinates, the prior's
            information included.
        sigma: of the reported values: how wide noise-free pictures leave the posterior. The mean of its square over the
            prior is the least mean squared error of any estimate; where sigma is small it is the Cramér–Rao bound.
    """

    knowledge: Knowledge
    sigma: Float[np.ndarray, "18"]


@in_float64
def ideal_of(of: World, expected: PanelShots, flat: np.ndarray, template: Backscatter) -> Ideal:
    """The best that the positions with these flat indices allow."""
    prior, free = prior_of(of.rig), TWO_PLANES.free > 0
    rays = grid_rays(template, flat)
    seen = evidence(expected, rays, flat, pictures_of(expected.shown, expected.crop))
    weight = weights(seen, seen.light, seen.light[0], 0.0, seen.usable)
    errors_at = errors_of(template, seen, weight, corners_of(template, of.x, rays))
    slopes = errors_at(of.x)[1]
    cov = np.linalg.inv(slopes.T @ slopes + np.diag(prior.sigma**-2.0))
    known = Knowledge(template, of.x, cov, 0.0, (True,) * len(expected.seen) + (True,))
    # The prior draws what is hardly seen towards its mean.
    found = most_probable(errors_at, of.x, free, prior.mean, prior.sigma)
    sigma = np.sqrt(np.diag(posterior_moments(errors_at, found, free, prior).cov))
    sigma[2] /= footprint_share(of.rig)
    return Ideal(known, sigma)


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
    shots = shots_of(of, rng, pictures)
    problem = problem_of(shots, of.term.geometry, of.rig, POSITIONS)
    # The order is known here; whether it is found is another question.
    choice = choose(problem, (TWO_PLANES,))
    result = told(choice, shots, of.rig, [])
    estimates = np.array([[e.value, e.sigma] for e in result.estimates]).T
    expected = noise_free(shots, of, pictures)
    ideal = ideal_of(of, expected, problem.flat, choice.problem.template)
    shown = np.stack([shots.crop.of(picture) for picture in new])
    predicted = predict_light(known_from(choice), shots, shown, _PLACES)
    limit = predict_light(ideal.knowledge, expected, shown, _PLACES)
    light = np.stack([predicted.rate - limit.rate, predicted.sigma, limit.sigma]).reshape(3, -1)
    return _One(np.stack([estimates[0] - of.values, estimates[1], ideal.sigma]), light)


def trials(share: float) -> list[Trials]:
    """Every reported parameter, and the light of a new picture at some positions."""
    found = [realisation(seed) for seed in range(max(int(REALISATIONS * share), 3))]
    parameters = np.stack([one.parameters for one in found])
    light = np.stack([one.light for one in found])
    names = [f"backscatter/{name}" for name in NAMES]
    of_names = [Trials(name, *(parameters[:, part, k : k + 1] for part in range(3))) for k, name in enumerate(names)]
    return [*of_names, Trials("backscatter/light of a new picture", light[:, 0], light[:, 1], light[:, 2])]
