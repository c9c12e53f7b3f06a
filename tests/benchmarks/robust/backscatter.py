"""Panels behind which light comes back: gammas, emitters, reflections, pictures and light of every kind."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float

from tests.benchmarks.robust.family import Answer, Case, Family, Number, of_result
from tests.scenes.backscatter import RULES, codes_of, panel_pictures, predicted_light, shots_of, small_rig, world
from udccal.fitting.backscatter.fit import fit_backscatter
from udccal.fitting.backscatter.parameters import KERNELS, Order
from udccal.numerics import in_float64

_PLACES = np.array([40, 95, 140, 190])


Curve = Callable[[Float[np.ndarray, "256"]], Float[np.ndarray, "256"]]
# Light, 0 to 1, of panels that are no power of their codes (0 to 1).
_CURVES: dict[str, Curve] = {
    "of sRGB": lambda code: np.where(code < 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4),
    "of video's range": lambda code: np.clip((255 * code - 16) / 219, 0, 1) ** 2.2,
    "with raised black": lambda code: np.maximum(code, 30 / 255) ** 2.2,
    "with a knee": lambda code: np.where(code < 0.8, code**2.2, 0.8**2.2 + 0.9 * (code**2.2 - 0.8**2.2)),
}


def draw(seed: int) -> Case:
    """A rig within its tolerances, of one of the model's orders, and its pictures; some panels leak or are no power."""
    rng = np.random.default_rng([seed, 24])
    order = KERNELS[int(rng.integers(len(KERNELS)))]
    white, pictures = float(np.exp(rng.uniform(np.log(2e3), np.log(2e5)))), int(rng.integers(6, 13))
    exposure_s = float(rng.uniform(0.01, 0.1))
    light = Light.drawn(np.random.default_rng([seed, 26]))
    what = f"{order.name}, white {white:.0e} e/s, {pictures} pictures of {exposure_s:.2f} s{light.what}"
    return Case(what, functools.partial(answer, seed, order, white, pictures, exposure_s, light))


@final
@dataclass(frozen=True)
class Light:
    """What a panel does besides a power of its codes.

    Attributes:
        leak: share of white that is in all shots but dark.
        curve: name of another curve, or nothing.
        white: brightness of white over that of the pictures.
    """

    leak: float
    curve: str
    white: float

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> Light:
        """A leak, another curve or a limiter of power, in an eighth of the panels each."""
        kind, leak = rng.integers(8), float(np.exp(rng.uniform(np.log(3e-4), np.log(0.05))))
        curve, white = str(rng.choice(list(_CURVES))), float(rng.uniform(0.5, 0.97))
        return cls(leak * (kind == 0), curve * int(kind == 1), white if kind == 2 else 1.0)

    @property
    def what(self) -> str:
        """In words."""
        limited = f", white of {self.white:.0%}" if self.white != 1 else ""
        return (f", {self.leak:.2%} leak" if self.leak else "") + f", curve {self.curve}" * bool(self.curve) + limited


@in_float64
def answer(seed: int, order: Order, white: float, pictures: int, exposure_s: float, light: Light) -> Answer:
    """Of the fit: the light of a new picture, which is what the term is for."""
    rng = np.random.default_rng([seed, 25])
    of = world(rng, small_rig(), order, white)
    shown = panel_pictures(of.rig, 100 * seed, pictures + 1)
    share = np.arange(256) / 255
    codes = codes_of(of, _CURVES[light.curve](share) / _CURVES[light.curve](share)[-1]) if light.curve else 255 * share
    data = shots_of(of, rng, shown[1:], exposure_s, codes, light.leak, light.white)
    result = fit_backscatter(data, of.term.geometry, of.rig, RULES)
    if not result.ok:
        return of_result(result, ())
    model_error = result.diagnostic("model_error_of_white") or 0.0
    found = predicted_light(result.term, result, model_error, of.rig, shown[:1], _PLACES)
    true = predicted_light(of.term, result, 0.0, of.rig, [codes[shown[0]]], _PLACES).rate
    parts = zip(found.rate.ravel() - true.ravel(), found.sigma.ravel(), strict=True)
    return of_result(result, tuple(Number(f"light {k}", float(e), float(s)) for k, (e, s) in enumerate(parts)))


FAMILY = Family("backscatter", draw)
