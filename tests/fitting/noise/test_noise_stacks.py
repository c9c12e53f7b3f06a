"""Stacks and averages that cannot be what they are given as are refused; sound ones are not."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.scenes.noise import PLAIN, captured, errors_in_sigma
from udccal.errors import FitError
from udccal.fitting.noise.data import Averaged, NoiseData, SpatialStack
from udccal.fitting.noise.fit import fit_noise
from udccal.result import FitStatus

SENSOR = replace(PLAIN, rows=144, columns=192, row_DN=0.0)
Frames = Sequence[np.ndarray]


@functools.cache
def sound() -> NoiseData:
    return captured(SENSOR, 3)


def with_stack(change: Callable[[Frames, Frames], tuple[Any, Any]]) -> NoiseData:
    given = sound().stack
    assert given is not None
    dark, bright = change(list(given.dark), list(given.bright))
    stack = SpatialStack(given.exposure_s, [], [])
    # What runs with types checked refuses some of them earlier.
    object.__setattr__(stack, "dark", dark)
    object.__setattr__(stack, "bright", bright)
    return replace(sound(), stack=stack)


def averaged(of: Frames, **changed: Any) -> Averaged:
    average = Averaged(0.05, np.mean(of, axis=0, dtype=np.float64).astype(np.float32), len(of))
    for name, value in changed.items():
        object.__setattr__(average, name, value)
    return average


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda dark, bright: (bright, dark), "frames may be lit"),
        (lambda dark, bright: ([*dark[1:], bright[0]], bright), "frames may be lit"),
        (lambda dark, bright: (averaged(bright), averaged(dark)), "frames may be lit"),
        (lambda dark, bright: (dark, dark), "frames may be dark"),
        (lambda dark, bright: (averaged(dark), averaged(dark)), "frames may be dark"),
        (lambda dark, bright: ([dark[0]] * 8, bright), "copies of one frame"),
        (lambda dark, bright: (dark, [*bright, bright[2]]), "copies of one frame"),
        (
            lambda dark, bright: (dark, [((a.astype(int) + b) // 2).astype(np.uint16) for a, b in _pairs(bright)]),
            "copies, averages",
        ),
        (lambda dark, bright: ([2 * frame - np.uint16(64) for frame in dark], bright), "temporal variance"),
    ],
)
def test_a_stack_that_contradicts_the_pairs_is_a_poor_fit(change: Any, words: str) -> None:
    result = fit_noise(with_stack(change))
    assert result.status is FitStatus.POOR_FIT
    assert words in result.notes[0]


def _pairs(frames: Frames) -> list[tuple[np.ndarray, np.ndarray]]:
    return list(zip(frames[::2], frames[1::2], strict=True))


@pytest.mark.parametrize(
    "change",
    [
        lambda dark, bright: (dark, bright),
        lambda dark, bright: (averaged(dark), averaged(bright)),
        # The lamp has become 20 % dimmer.
        lambda dark, bright: (dark, [np.random.default_rng(1).binomial(frame - 64, 0.8) + 64 for frame in bright]),
    ],
)
def test_a_stack_like_the_pairs_is_none(change: Any) -> None:
    frames = with_stack(lambda dark, bright: tuple(_codes(one) for one in change(dark, bright)))
    assert not any("stack of about" in note or "stack, " in note for note in fit_noise(frames).notes)


def _codes(frames: Any) -> Any:
    return frames if isinstance(frames, Averaged) else [frame.astype(np.uint16) for frame in frames]


@pytest.mark.medium
def test_a_stack_shorter_than_all_dark_pairs_contradicts_nothing() -> None:
    """It has less dark current, and less noise of it, than any of them."""
    sensor = replace(SENSOR, dark_e_per_s=300.0, read_e=1.5, dark_times_s=(0.5, 1.0, 2.0, 4.0))
    result = fit_noise(captured(sensor, 3))
    assert result.status is FitStatus.CONVERGED
    assert np.abs(errors_in_sigma(result, sensor)).max() < 4.5


def test_frames_of_one_code_may_agree() -> None:
    """Noise far below a code: all dark frames are the same, and no copies."""
    data = captured(replace(SENSOR, K_DN_per_e=0.02, read_e=1.0, DSNU_e=0.0, dark_e_per_s=0.0), 3)
    assert not any("copies" in note for note in fit_noise(data).notes)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"frames": 0}, "the frames of an average in the stack .* found 0"),
        ({"frames": -1}, "found -1"),
        ({"frames": float("nan")}, "found nan"),
        ({"frames": None}, "found NoneType"),
        ({"mean_DN": np.zeros((144, 192), np.uint16)}, "found uint16"),
        ({"mean_DN": np.zeros((5, 5), np.float32)}, r"found float32 of shape \(5, 5\)"),
        ({"mean_DN": [[0.0]]}, "found list"),
        ({"mean_DN": None}, "found NoneType"),
        ({"mean_DN": np.full((144, 192), np.nan, np.float32)}, "27648 samples that are no number"),
        ({"exposure_s": -3.0}, "an average of the stack to have an exposure in seconds .* found -3"),
    ],
)
def test_an_average_of_no_frames_is_refused(change: dict[str, Any], words: str) -> None:
    with pytest.raises(FitError, match=words):
        fit_noise(with_stack(lambda dark, bright: (dark, averaged(bright, **change))))


def test_an_average_says_what_its_frames_say() -> None:
    result = fit_noise(with_stack(lambda dark, bright: (averaged(dark), averaged(bright))))
    assert np.abs(errors_in_sigma(result, SENSOR)).max() < 4.5


@pytest.mark.parametrize("bad", [slice(None), slice(2, 3)])
def test_dark_pairs_of_one_frame_are_a_poor_fit(bad: slice) -> None:
    """They show no read noise: sigma_d was 0.08 electrons instead of 4."""
    levels = [of for of in sound().levels if of.dark]
    levels[bad] = [replace(of, dark=(of.dark[0], np.array(of.dark[0]))) for of in levels[bad]]
    result = fit_noise(replace(sound(), levels=[*levels, *(of for of in sound().levels if of.bright)]))
    assert result.status is FitStatus.POOR_FIT
    assert "copies of one frame at" in result.notes[0]
