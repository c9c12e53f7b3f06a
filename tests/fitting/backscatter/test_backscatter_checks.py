"""Data that cannot be are refused with a sentence before any fit."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.scenes.backscatter import RULES, panel_pictures, shots_of, small_rig, world_at
from tests.scenes.unchecked import checked_with, unchecked
from udccal.errors import FitError
from udccal.fitting.backscatter.data import BackscatterData
from udccal.fitting.backscatter.fit import fit_backscatter
from udccal.fitting.backscatter.parameters import prior_of

RIG = small_rig()
WORLD = world_at(prior_of(RIG).mean, RIG, np.full((3, 1, 1), 2e4))
SENTENCE = r"^Expected .*, found .*\. [A-Z].*\.$"


@pytest.fixture(scope="module")
def data() -> BackscatterData:
    return shots_of(WORLD, np.random.default_rng(0), panel_pictures(RIG, 70, 6))


def spoilt(values: np.ndarray, shot: int, value: float) -> np.ndarray:
    values = values.copy()
    values[shot, 1, 3, 4] = value
    return values


@pytest.mark.parametrize("shot", [0, 3, -1], ids=["white", "a picture", "dark"])
@pytest.mark.parametrize(
    ("name", "value"), [("rate", np.nan), ("rate", np.inf), ("shot", 0.0), ("rest", np.nan), ("rest", -1.0)]
)
def test_a_bin_with_a_number_that_cannot_be_is_named(data: BackscatterData, shot: int, name: str, value: float) -> None:
    shots = unchecked(data.shots, **{name: spoilt(getattr(data.shots, name), shot, value)})
    place = ("white", *data.names, "dark")[shot]
    with pytest.raises(FitError, match=rf"found 1 others, the first in {place}, G, bin \(4, 3\)"):
        checked_with(data, {"shots": shots})


@pytest.mark.parametrize("exposure_s", [0.0, np.nan, -1.0])
def test_exposures_that_cannot_be_are_refused(data: BackscatterData, exposure_s: float) -> None:
    with pytest.raises(FitError, match=r"Expected positive exposures, found"):
        checked_with(data, {"shots": unchecked(data.shots, exposure_s=np.full(8, exposure_s))})


@pytest.mark.parametrize(
    "change",
    [
        {"shown": lambda data: data.shown[:-1]},
        {"shown": lambda data: data.shown / 255},
        {"shown": lambda data: data.shown[:, 1:]},
        {"names": lambda data: data.names[:3]},
        {"shots": lambda data: data.shots.part(slice(0, 1))},
        {"shots": lambda data: data.shots.at(np.arange(20))},
    ],
    ids=["a picture less", "float pictures", "another crop", "fewer names", "white alone", "a flat grid"],
)
def test_pictures_and_names_that_are_not_those_of_the_shots_are_refused(data: BackscatterData, change: Any) -> None:
    with pytest.raises(FitError, match=SENTENCE):
        checked_with(data, {name: of(data) for name, of in change.items()})


@pytest.mark.parametrize(
    "change",
    [
        {"rate": lambda shots: shots.rate.tolist()},
        {"rate": lambda shots: shots.rate[:, 0]},
        {"shot": lambda shots: shots.shot[:3]},
        {"clipped": lambda shots: shots.clipped.astype(int)},
        {"exposure_s": lambda shots: shots.exposure_s[:3]},
    ],
    ids=["a list", "no colours", "fewer variances", "whole numbers for clipped", "fewer exposures"],
)
def test_arrays_of_shots_of_another_kind_or_shape_are_refused(data: BackscatterData, change: Any) -> None:
    with pytest.raises(FitError, match=SENTENCE):
        checked_with(data.shots, {name: of(data.shots) for name, of in change.items()})


def test_another_sensors_grid_is_refused(data: BackscatterData) -> None:
    shots = data.shots
    cropped = {name: getattr(shots, name)[..., :-3] for name in ("rate", "shot", "rest", "clipped")}
    with pytest.raises(FitError, match=r"Expected a grid of .* Bin all of the sensor\."):
        fit_backscatter(unchecked(data, shots=unchecked(shots, **cropped)), WORLD.term.geometry, RIG, RULES)
