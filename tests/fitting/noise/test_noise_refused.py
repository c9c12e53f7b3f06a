"""What is no frame, no exposure and no level of a noise measurement is refused with a sentence."""

from __future__ import annotations

import inspect
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.scenes.noise import PLAIN, capture
from udccal.errors import FitError
from udccal.fitting.noise.data import ExposureLevel, NoiseData, SpatialStack
from udccal.fitting.noise.fit import fit_noise
from udccal.result import FitStatus

FRAME = np.full((32, 32), 100, np.uint16)
MASKED = np.ma.masked_greater(FRAME, 0)


@pytest.mark.parametrize(
    ("levels", "stack", "sentence"),
    [
        ([ExposureLevel(0.1, (FRAME,), ())], None, "two dark frames"),
        ([ExposureLevel(-1.0, (FRAME, FRAME), ())], None, "exposure in seconds"),
        ([ExposureLevel(float("nan"), (FRAME, FRAME), ())], None, "exposure in seconds"),
        ([ExposureLevel(0.1, (FRAME, FRAME), (FRAME, FRAME), -5.0)], None, "number of photons"),
        ([], SpatialStack(float("nan"), [FRAME] * 2, [FRAME] * 2), "the stack to have an exposure in seconds"),
        ([], SpatialStack(0.1, [FRAME] * 2, [FRAME] * 2, -5.0), "the stack to have a number of photons"),
        ([ExposureLevel(0.1, (FRAME, FRAME[:20]), (FRAME, FRAME))], None, "found"),
        ([ExposureLevel(0.1, (lambda: FRAME.astype(float), FRAME), (FRAME, FRAME))], None, "uint8 or uint16"),
        ([ExposureLevel(0.1, (lambda: "frame", FRAME), (FRAME, FRAME))], None, "found str"),
        ([ExposureLevel(0.1, (MASKED, FRAME), (FRAME, FRAME))], None, "dark frame 0 .* without masked entries"),
        ([ExposureLevel(0.1, (FRAME[:4], FRAME[:4]), (FRAME, FRAME))], None, "samples a side"),
        ([ExposureLevel(0.1, (FRAME, FRAME), (FRAME, FRAME))], SpatialStack(0.1, [FRAME], [FRAME]), "stack"),
        ([ExposureLevel(0.1, (FRAME, FRAME), (FRAME + np.uint16(60000),) * 2)], None, "top_code"),
        ([ExposureLevel(0.1, (FRAME + np.uint16(60000),) * 2, (FRAME, FRAME))], None, "exchanged"),
    ],
)
def test_what_is_no_frame_is_refused(levels: list[ExposureLevel], stack: SpatialStack | None, sentence: str) -> None:
    with pytest.raises(FitError, match=sentence):
        fit_noise(NoiseData(levels, stack, top_code=4095))


def _unplugged() -> np.ndarray:
    raise OSError("disk gone")


def test_a_frame_that_cannot_be_loaded_is_named() -> None:
    """The function's own error came through, which says nothing of the frame."""
    levels = [ExposureLevel(0.1, (FRAME, FRAME), (FRAME, FRAME)), ExposureLevel(0.2, (FRAME, _unplugged), ())]
    with pytest.raises(FitError, match=r"loads dark frame 1 of the pair of 0\.2 s, found OSError: disk gone"):
        fit_noise(NoiseData(levels))


@pytest.mark.parametrize(("arguments", "kind"), [((5, None), "Noise"), ((None, 5), "NoiseRules")])
def test_arguments_of_another_kind_are_refused(arguments: tuple[Any, Any], kind: str) -> None:
    """They ended in an AttributeError, or in the result."""
    without_checks_of_types = inspect.unwrap(fit_noise)
    with pytest.raises(FitError, match=f"Expected a {kind}, found 5"):
        without_checks_of_types(NoiseData([]), *arguments)


def test_an_exposure_that_is_a_frame_is_refused() -> None:
    level = ExposureLevel(0.1, (FRAME, FRAME), (FRAME, FRAME))
    # What runs with types checked refuses it earlier.
    object.__setattr__(level, "exposure_s", FRAME)
    with pytest.raises(FitError, match=r"level 0 to have an exposure in seconds .* found uint16 of shape \(32, 32\)"):
        fit_noise(NoiseData([level]))


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({"levels": None}, "sequence of exposure levels, found NoneType"),
        ({"levels": (level for level in [])}, "sequence of exposure levels, found generator"),
        ({"levels": ExposureLevel(0.1)}, "sequence of exposure levels, found ExposureLevel"),
        ({"levels": [FRAME]}, "every level as an ExposureLevel, found uint16"),
        ({"stack": "a"}, "Expected a SpatialStack, found 'a'"),
        ({"top_code": "4095"}, "top_code as a whole number from 1 to 65535, found '4095'"),
        ({"top_code": float("nan")}, "found nan"),
        ({"top_code": 1e9}, "found 1000000000.0"),
        ({"top_code": True}, "found True"),
        ({"top_code": 70_000}, "found 70000"),
    ],
)
def test_data_of_another_kind_are_refused(changed: dict[str, Any], sentence: str) -> None:
    data = NoiseData([ExposureLevel(0.1, (FRAME, FRAME), (FRAME, FRAME))])
    for name, value in changed.items():
        object.__setattr__(data, name, value)
    with pytest.raises(FitError, match=sentence):
        fit_noise(data)


@pytest.mark.parametrize(
    ("name", "value", "sentence"),
    [
        ("exposure_s", True, "level 0 to have an exposure in seconds .* found True"),
        ("photons", True, "level 0 to have a number of photons .* found True"),
        ("dark", None, "dark frames of level 0 as a sequence, found NoneType"),
        ("bright", (frame for frame in [FRAME]), "bright frames of level 0 as a sequence, found generator"),
    ],
)
def test_a_level_of_another_kind_is_refused(name: str, value: Any, sentence: str) -> None:
    level = ExposureLevel(0.1, (FRAME, FRAME), (FRAME, FRAME))
    object.__setattr__(level, name, value)
    with pytest.raises(FitError, match=sentence):
        fit_noise(NoiseData([level]))


def test_pairs_may_be_arrays() -> None:
    levels, stack = capture(PLAIN, 3)
    stacked = [replace(of, dark=np.stack(list(of.dark)), bright=np.stack(list(of.bright))) for of in levels]
    alike = [fit_noise(NoiseData(these, stack, top_code=4095)) for these in (levels, stacked)]
    assert [one.value for one in alike[0].estimates] == [one.value for one in alike[1].estimates]


def test_nothing_at_all_is_too_few() -> None:
    assert fit_noise(NoiseData([])).status is FitStatus.TOO_FEW_DATA
