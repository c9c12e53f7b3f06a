"""Light that the model of the panel does not have: leaks in all shots but dark, and codes that are no power."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from jaxtyping import Float

from tests.scenes.backscatter import RULES, codes_of, panel_pictures, predicted_light, shots_of, small_rig, world
from udccal.fitting.backscatter.fit import fit_backscatter
from udccal.fitting.backscatter.parameters import KERNELS
from udccal.result import FitResult

Codes = Float[np.ndarray, "256"]
RIG = small_rig()
PLACES = np.array([40, 95, 140, 190])


def _told(result: FitResult, words: str) -> bool:
    return any(words in note for note in result.notes)


@pytest.mark.medium
@pytest.mark.parametrize("seed", range(3))
def test_a_leak_in_all_shots_but_dark_is_told_and_moves_nothing(seed: int) -> None:
    of, pictures = world(np.random.default_rng(seed), RIG, KERNELS[seed]), panel_pictures(RIG, 100 * seed, 9)
    clean, leak = (
        fit_backscatter(shots_of(of, np.random.default_rng(7), pictures, leak=share), of.term.geometry, RIG, RULES)
        for share in (0.0, 0.01)
    )
    assert not _told(clean, "dark frame")
    assert _told(leak, "White and pictures have light that the dark frame has not, ")
    assert [one.places for one in leak.outliers if one.rule == "dark frames of other light"] == [("dark",)]
    assert not _told(leak, "Ratios to white are modelled")
    for name in ("gamma", "standoff_mm", "mix_rg"):
        before, after = clean.estimate(name), leak.estimate(name)
        assert abs(after.value - before.value) < 3 * np.hypot(before.sigma, after.sigma)
    # The dark frame told about as much as one more picture.
    assert leak.estimate("gamma").sigma < 3 * clean.estimate("gamma").sigma


def _srgb(code: Codes) -> Codes:
    share = code / 255
    return np.where(share < 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)


def _limited(code: Codes) -> Codes:
    return (np.clip(code - 16, 0, 219) / 219) ** 2.2


@pytest.mark.medium
@pytest.mark.parametrize("light", [_srgb, _limited])
def test_a_panel_of_another_curve_is_told_and_new_pictures_are_within_their_sigmas(
    light: Callable[[Codes], Codes],
) -> None:
    of, pictures = world(np.random.default_rng(78), RIG, KERNELS[1]), panel_pictures(RIG, 300, 11)
    other = codes_of(of, light(np.arange(256.0)))
    power, curve = (
        fit_backscatter(shots_of(of, np.random.default_rng(7), pictures[2:], codes=codes), of.term.geometry, RIG, RULES)
        for codes in (None, other)
    )
    assert not _told(power, "no power of its codes")
    assert _told(curve, "The panel's light is no power of its codes (p = ")
    # The curve has more light at dark codes, or less; that is no leak.
    assert not _told(curve, "dark frame")
    assert curve.estimate("gamma").sigma > 5 * power.estimate("gamma").sigma
    found = predicted_light(
        curve.term, curve, curve.diagnostic("model_error_of_white") or 0.0, RIG, pictures[:2], PLACES
    )
    true = predicted_light(of.term, curve, 0.0, RIG, [other[one] for one in pictures[:2]], PLACES)
    assert np.abs((found.rate - true.rate) / found.sigma).max() < 4.5


@pytest.mark.medium
@pytest.mark.parametrize("white", [0.95, 0.6])
def test_a_panel_that_limits_its_power_is_told_and_moves_nothing(white: float) -> None:
    """A white of 70 % left new pictures off by 5 % of white, POOR_FIT."""
    of, pictures = world(np.random.default_rng(78), RIG, KERNELS[1]), panel_pictures(RIG, 300, 11)
    whole, limited = (
        fit_backscatter(
            shots_of(of, np.random.default_rng(7), pictures[2:], brightness=brightness), of.term.geometry, RIG, RULES
        )
        for brightness in (1.0, white)
    )
    assert not _told(whole, "of the brightness that the pictures predict")
    assert _told(limited, f"White has {100 * white:.3g} % of the brightness that the pictures predict")
    for name in ("gamma", "standoff_mm", "mix_rg"):
        before, after = whole.estimate(name), limited.estimate(name)
        assert abs(after.value - before.value) < 3 * np.hypot(before.sigma, after.sigma)
    found, true = (predicted_light(one, limited, 0.0, RIG, pictures[:2], PLACES) for one in (limited.term, of.term))
    assert np.abs((found.rate - true.rate) / found.sigma).max() < 4.5
    assert np.abs(found.rate - true.rate).max() < 1e-3 * np.asarray(of.term.mask).max()
