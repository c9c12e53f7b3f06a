"""Small rigs whose backscatter is known: pictures on the panel, noise, and the light of new pictures."""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import numpy as np
from jaxtyping import Float

from udccal.displays.pictures import face_picture
from udccal.fitting.backscatter.data import BackscatterData, Binned
from udccal.fitting.backscatter.model import grid_rays, grid_step, window_for
from udccal.fitting.backscatter.parameters import (
    TWO_PLANES,
    BackscatterRules,
    Order,
    footprint_per_pupil,
    linear_of,
    prior_of,
    values_of,
    with_linear,
)
from udccal.fitting.backscatter.read import visible_crop
from udccal.fitting.engine.gaussian import Posterior
from udccal.fitting.nominal import nominal_backscatter, nominal_geometry
from udccal.models.backscatter import Backscatter, panel_response, response_grid
from udccal.numerics import in_float64
from udccal.result import FitResult
from udccal.rig import Nominal, RigDescription, load_rig

POSITIONS = 24


RULES = BackscatterRules(positions=POSITIONS)


PICTURES = 8


EXPOSURE_S = 0.05


_READ_E = 2.5


# Of samples and frames behind a bin's average: 16 x 16 pixels, four frames.
_SAMPLES = 1024


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
        values[2] /= footprint_per_pupil(self.rig)
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
    term = with_linear(replace(template, window=window_for(template, theta, rays, 1.0)), theta)
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


def codes_of(of: World, light: Float[np.ndarray, "256"]) -> Float[np.ndarray, "256"]:
    """Codes at which the world's panel has this light, from 0 to 1, as another panel has it at each code."""
    return 255 * light ** (1 / float(np.asarray(of.term.gamma)))


def shots_of(
    of: World,
    rng: np.random.Generator,
    pictures: list[np.ndarray],
    exposure_s: float = EXPOSURE_S,
    codes: Float[np.ndarray, "256"] | None = None,
    leak: float = 0.0,
    brightness: float = 1.0,
) -> BackscatterData:
    """White, dark and pictures with noise.

    ``codes`` are those that the panel makes of the pictures' (``codes_of``). ``leak`` is a share of white that is in
    all shots but dark, and grows across the sensor. White is shown at ``brightness`` times that of the pictures.
    """
    crop = visible_crop(of.term.geometry, of.rig)
    panel = of.rig.panel
    white = np.full((panel.rows, panel.columns, 3), 255, np.uint8)
    rates = clean_light(of, [white, *(pictures if codes is None else [codes[one] for one in pictures])])
    rates[0] = brightness * rates[0]
    more = leak * np.median(rates[0], axis=(1, 2), keepdims=True) * np.linspace(0.7, 1.3, rates[0].shape[2])
    light = *(rate + more for rate in rates), np.zeros_like(rates[0])
    shots = Binned.joined([measured(rate, rng, exposure_s) for rate in light])
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
