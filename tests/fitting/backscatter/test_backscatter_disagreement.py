"""Error bars of kernels that are not the same all over the sensor, and of pictures of unequal brightness."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.scenes.backscatter import RULES, panel_pictures, shots_of, small_rig, world_at
from udccal.fitting.backscatter.data import BackscatterData
from udccal.fitting.backscatter.fit import fit_backscatter
from udccal.fitting.backscatter.parameters import NAMES, TWO_PLANES, prior_of
from udccal.result import FitResult

RIG = small_rig()
GEOMETRY = world_at(prior_of(RIG).mean, RIG, np.full((3, 1, 1), 2e4)).term.geometry
PICTURES = panel_pictures(RIG, 70, 12)


def _shots(offset_px: float, seed: int) -> BackscatterData:
    x = TWO_PLANES.start(prior_of(RIG).mean, prior_of(RIG))
    x[NAMES.index("offset_x_px")] = offset_px
    return shots_of(world_at(x, RIG, np.full((3, 1, 1), 2e4)), np.random.default_rng(seed), PICTURES)


def _fitted(*halves_px: float) -> FitResult:
    """The left and the right half of the sensor see the emitters at these offsets."""
    left, right = (_shots(offset, seed) for seed, offset in enumerate(halves_px))
    middle = left.shots.rate.shape[3] // 2
    rate = np.concatenate([left.shots.rate[..., :middle], right.shots.rate[..., middle:]], axis=3)
    return fit_backscatter(replace(left, shots=replace(left.shots, rate=rate)), GEOMETRY, RIG, RULES)


@pytest.mark.medium
def test_parts_of_the_sensor_that_disagree_widen_the_error_bars_and_are_told() -> None:
    same, apart = _fitted(0.1, 0.1), _fitted(-0.1, 0.3)
    assert not any("different kernels" in note for note in same.notes)
    assert any("different kernels" in note for note in apart.notes)
    sigma = {name: fit.estimate("offset_x_px").sigma for name, fit in (("same", same), ("apart", apart))}
    assert sigma["apart"] > 3 * sigma["same"]
    # The mean of both halves, within what each half says.
    assert abs(apart.estimate("offset_x_px").value - 0.1) < 3 * sigma["apart"]


@pytest.mark.medium
def test_pictures_of_unequal_brightness_are_told_and_in_the_error_bars() -> None:
    data, truth = _shots(0.1, 4), world_at(prior_of(RIG).mean, RIG, np.full((3, 1, 1), 2e4)).term
    brightness = 1 + 3e-3 * np.random.default_rng(8).standard_normal((len(data.shots.rate), 1, 1, 1))
    uneven = replace(data, shots=replace(data.shots, rate=data.shots.rate * brightness))
    sound, told = (fit_backscatter(one, GEOMETRY, RIG, RULES) for one in (data, uneven))
    assert not any("brightness differs" in note for note in sound.notes)
    assert any("The panel's brightness differs by 0." in note for note in told.notes)
    assert not any("different kernels" in note for note in told.notes)
    gamma = told.estimate("gamma")
    assert abs(gamma.value - float(np.asarray(truth.gamma))) < 4 * gamma.sigma
    assert gamma.sigma > 5 * sound.estimate("gamma").sigma
    # The term's own error bars have it, too.
    by_term = told.sigma_of(lambda term: np.asarray(term.gamma).reshape(1))
    assert by_term[0] == pytest.approx(gamma.sigma, rel=0.2)
