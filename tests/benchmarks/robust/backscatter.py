"""Panels behind which light comes back: gammas, emitters, reflections, pictures and light of every kind."""

from __future__ import annotations

import functools

import numpy as np

from tests.benchmarks.robust.family import Answer, Case, Family, Number, of_result
from tests.scenes.backscatter import RULES, panel_pictures, predicted_light, shots_of, small_rig, world
from udccal.fitting.backscatter.fit import fit_backscatter
from udccal.fitting.backscatter.parameters import KERNELS, Order
from udccal.numerics import in_float64

_PLACES = np.array([40, 95, 140, 190])


def draw(seed: int) -> Case:
    """A rig within its tolerances, of one of the model's orders, and its pictures."""
    rng = np.random.default_rng([seed, 24])
    order = KERNELS[int(rng.integers(len(KERNELS)))]
    white, pictures = float(np.exp(rng.uniform(np.log(2e3), np.log(2e5)))), int(rng.integers(6, 13))
    exposure_s = float(rng.uniform(0.01, 0.1))
    what = f"{order.name}, white {white:.0e} e/s, {pictures} pictures of {exposure_s:.2f} s"
    return Case(what, functools.partial(answer, seed, order, white, pictures, exposure_s))


@in_float64
def answer(seed: int, order: Order, white: float, pictures: int, exposure_s: float) -> Answer:
    """Of the fit: the light of a new picture, which is what the term is for."""
    rng = np.random.default_rng([seed, 25])
    of = world(rng, small_rig(), order, white)
    shown = panel_pictures(of.rig, 100 * seed, pictures + 1)
    result = fit_backscatter(shots_of(of, rng, shown[1:], exposure_s), of.term.geometry, of.rig, RULES)
    if not result.ok:
        return of_result(result, ())
    model_error = next((one.value for one in result.diagnostics if one.name == "model_error_of_white"), 0.0)
    found = predicted_light(result.term, result, model_error, of.rig, shown[:1], _PLACES)
    true = predicted_light(of.term, result, 0.0, of.rig, shown[:1], _PLACES).rate
    parts = zip(found.rate.ravel() - true.ravel(), found.sigma.ravel(), strict=True)
    return of_result(result, tuple(Number(f"light {k}", float(e), float(s)) for k, (e, s) in enumerate(parts)))


FAMILY = Family("backscatter", draw)
