"""Frames that are not fit are left out, counted with their reason, and replaced."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest

from procedures.capture import take
from procedures.plans import Bracket, Singles, Stack
from udccal.cameras.protocol import (
    CameraIdentity,
    Counts,
    Features,
    Frame,
    Mode,
    Range,
    Region,
    Settings,
    Trigger,
)
from udccal.errors import CaptureError
from udccal.sessions.frame_checks import FrameLimits

REGION = Region(0, 0, 64, 48)
LIMITS = FrameLimits(black_DN=64.0, saturation_DN=4095.0)
LONGEST_S = 0.1


class Spoiled:
    """A camera that looks at a small light; a test spoils the frames it chooses."""

    def __init__(self, spoil: Callable[[int, np.ndarray], np.ndarray] = lambda index, light: light) -> None:
        self.spoil, self.taken, self.torn = spoil, 0, frozenset[int]()
        self.longest_s = LONGEST_S
        self.settings = Settings(0.001, 0.0, REGION)
        self.identity, self.sensor = CameraIdentity("a", "b", "c", "d"), REGION
        self.cfa, self.bits, self.mode, self.counts = "RGGB", 12, Mode("BayerRG12"), Counts()
        free = (Trigger.FREE_RUN,)
        limits = Range(1e-5, LONGEST_S)
        self.features = Features(limits, Range(0.0, 0.0), Range(1.0, 120.0), ("BayerRG12",), free, (2, 2, 2, 2))

    def __enter__(self) -> Spoiled:
        return self

    def __exit__(self, kind, error, trace) -> None:
        pass

    def set_mode(self, mode: Mode) -> Mode:
        return self.mode

    def configure(self, settings: Settings) -> Settings:
        self.settings = Settings(min(settings.exposure_s, self.longest_s), 0.0, settings.region)
        return self.settings

    def frames(self, count: int) -> Iterator[Frame]:
        rows, columns = np.mgrid[:48, :64]
        light = 2.5e6 * np.exp(-((columns - 30.2) ** 2 + (rows - 24.7) ** 2) / 18.0) + 2e4 * (np.abs(columns - 30) < 4)
        for _ in range(count):
            index, self.taken = self.taken, self.taken + 1
            rng = np.random.default_rng(index)
            electrons = rng.poisson(self.spoil(index, light) * self.settings.exposure_s)
            noisy = 0.355 * electrons + rng.normal(64, 2, light.shape)
            data = noisy.round().clip(0, 4095).astype(np.uint16)
            yield Frame(data, self.settings, 0.1 * index, index, index not in self.torn)


def reasons(captures) -> list[dict[str, int]]:
    return [{item.reason: item.frames for item in capture.rejected} for capture in captures]


def test_a_bracket_replaces_frames_whose_light_changed_or_moved() -> None:
    def spoil(index: int, light: np.ndarray) -> np.ndarray:
        return {1: 1.4 * light, 3: np.roll(light, 2, axis=1)}.get(index, light)

    camera = Spoiled(spoil)
    camera.torn = frozenset({2})
    captures = take(camera, REGION, 0.0005, Bracket(4), LIMITS, LONGEST_S)
    assert [capture.frame.settings.exposure_s for capture in captures] == pytest.approx([0.0005, 0.002, 0.008, 0.032])
    assert reasons(captures) == [{}, {"flicker": 1, "incomplete": 1, "motion": 1}, {}, {}]


def test_a_bracket_whose_light_stays_changed_is_refused() -> None:
    camera = Spoiled(lambda index, light: light if index == 0 else 1.5 * light)
    with pytest.raises(CaptureError, match=r"Expected a usable frame, found .* \(4 flicker\)"):
        take(camera, REGION, 0.0005, Bracket(3), LIMITS, LONGEST_S)


def test_a_bracket_ends_where_the_camera_does() -> None:
    camera = Spoiled()
    camera.longest_s = 0.003
    captures = take(camera, REGION, 0.0005, Bracket(6), LIMITS, LONGEST_S)
    assert [capture.frame.settings.exposure_s for capture in captures] == pytest.approx([0.0005, 0.002, 0.003])


def test_a_pair_is_taken_again_when_its_light_disagrees() -> None:
    camera = Spoiled(lambda index, light: (1.1 if index == 1 else 1.0) * light)
    captures = take(camera, REGION, 0.0005, Singles(2), LIMITS, LONGEST_S)
    assert [capture.frame.frame_id for capture in captures] == [2, 3]
    assert reasons(captures) == [{"flicker": 2}, {}]
    flickering = Spoiled(lambda index, light: (1.0 + 0.1 * (index % 2)) * light)
    with pytest.raises(CaptureError, match=r"Expected a steady light, found .* \(8 flicker\)"):
        take(flickering, REGION, 0.0005, Singles(2), LIMITS, LONGEST_S)


def test_a_leak_in_a_dark_pair_is_replaced() -> None:
    dark = FrameLimits(64.0, 4095.0, dark_DN=80.0)
    camera = Spoiled(lambda index, light: np.full_like(light, 1e6 if index == 0 else 0.0))
    captures = take(camera, REGION, 0.0005, Singles(2), dark, LONGEST_S)
    assert reasons(captures) == [{"light leak": 1}, {}]


def test_single_frames_may_clip_and_averages_may_not() -> None:
    bright = Spoiled(lambda index, light: 1e3 * light)
    assert len(take(bright, REGION, 0.001, Singles(2), LIMITS, LONGEST_S)) == 2
    with pytest.raises(CaptureError, match="saturated"):
        take(bright, REGION, 0.001, Stack(8), LIMITS, LONGEST_S)
