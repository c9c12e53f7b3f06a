from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from procedures.metering import meter, spot_level, trial_frame
from procedures.plans import Metered
from udccal.cameras.protocol import CameraIdentity, Counts, Features, Frame, Mode, Range, Region, Settings, Trigger
from udccal.errors import CaptureError
from udccal.rig import load_rig

RIG = load_rig("lg55-reduced")
REGION = Region(0, 0, 32, 24)
WELL_DN = RIG.camera.K_DN_per_e.value * RIG.camera.full_well_e.value


class Scripted:
    """A camera that sees given rates (e-/s) without noise."""

    def __init__(self, rate: np.ndarray, complete: bool = True) -> None:
        self.rate, self.complete = rate, complete
        self.settings = Settings(0.01, 0.0, REGION)
        self.taken: list[float] = []
        self.identity = CameraIdentity("a", "b", "c", "d")
        self.sensor, self.cfa, self.bits = REGION, "RGGB", 12
        self.mode, self.counts = Mode("BayerRG12"), Counts()
        limits = Range(RIG.camera.min_exposure_s, RIG.camera.max_exposure_s)
        free = (Trigger.FREE_RUN,)
        self.features = Features(limits, Range(0.0, 0.0), Range(1.0, 120.0), ("BayerRG12",), free, (2, 2, 2, 2))

    def __enter__(self) -> Scripted:
        return self

    def __exit__(self, kind, error, trace) -> None:
        pass

    def set_mode(self, mode: Mode) -> Mode:
        return self.mode

    def configure(self, settings: Settings) -> Settings:
        self.settings = settings
        return settings

    def frames(self, count: int) -> Iterator[Frame]:
        for index in range(count):
            self.taken.append(self.settings.exposure_s)
            signal = RIG.camera.K_DN_per_e.value * self.rate * self.settings.exposure_s
            data = np.rint(64 + np.minimum(signal, WELL_DN)).astype(np.uint16)
            yield Frame(data, self.settings, 0.0, index, self.complete)


def even(rate: float) -> Scripted:
    return Scripted(np.full((24, 32), rate))


def led(rate: float) -> Scripted:
    light = np.zeros((24, 32))
    light[10:13, 15:18] = np.array([[1, 3, 1], [4, 10, 4], [1, 3, 1]]) * rate / 10
    return Scripted(light)


@pytest.mark.parametrize("rate", [2e3, 1e5, 1e7])
def test_an_even_light_reaches_its_target_in_a_few_frames(rate: float) -> None:
    camera = even(rate)
    exposed = meter(camera, REGION, Metered(0.65), RIG)
    assert (exposed.frame.data.max() - 64) / WELL_DN == pytest.approx(0.65, rel=0.06)
    assert len(camera.taken) <= 8


@pytest.mark.parametrize("rate", [1e4, 1e6, 1e8])
def test_the_brightest_sample_of_an_led_reaches_its_target(rate: float) -> None:
    exposed = meter(led(rate), REGION, Metered(0.8, "spot"), RIG)
    assert (exposed.frame.data.max() - 64) / WELL_DN == pytest.approx(0.8, rel=0.06)


def test_a_good_guess_is_one_frame() -> None:
    camera = even(1e5)
    meter(camera, REGION, Metered(0.65), RIG, start_s=0.65 * 11000 / 1e5)
    assert len(camera.taken) == 1


def test_a_flat_that_saturates_at_the_shortest_exposure_is_refused() -> None:
    with pytest.raises(CaptureError, match=r"clipped at the shortest exposure of 2e-05 s. Dim the light"):
        meter(even(1e12), REGION, Metered(0.65), RIG)


def test_an_all_black_led_frame_is_refused() -> None:
    with pytest.raises(CaptureError, match=r"Expected to see the LED, found only 0.0% .* switched on"):
        meter(led(0.0), REGION, Metered(0.8, "spot"), RIG)


def test_a_hot_pixel_is_not_an_led() -> None:
    camera = led(0.0)
    camera.rate[5, 5] = 1e5
    with pytest.raises(CaptureError, match="Expected to see the LED"):
        meter(camera, REGION, Metered(0.8, "spot"), RIG)
    frame = trial_frame(led(5e4), REGION, 0.1).data
    hot = frame.copy()
    hot[3, 3] = 4000
    assert spot_level(hot, RIG) == pytest.approx(spot_level(frame, RIG), abs=0.01)


def test_a_dim_light_is_taken_at_the_longest_exposure() -> None:
    rate = 0.4 * 11000 / RIG.camera.max_exposure_s
    assert meter(even(rate), REGION, Metered(0.8), RIG).exposure_s == RIG.camera.max_exposure_s


def test_torn_frames_are_refused() -> None:
    with pytest.raises(CaptureError, match="complete test frame"):
        trial_frame(Scripted(np.zeros((24, 32)), complete=False), REGION, 0.1)


class OneExposure(Scripted):
    """As files are: whatever is asked for, there is one exposure."""

    def configure(self, settings: Settings) -> Settings:
        self.settings = Settings(0.02, 0.0, settings.region)
        return self.settings


def test_a_camera_with_one_exposure_is_taken_as_it_is_unless_it_clips_or_shows_nothing() -> None:
    rate = 0.4 * 11000 / 0.02
    exposed = meter(OneExposure(np.full((24, 32), rate)), REGION, Metered(0.65), RIG)
    assert exposed.exposure_s == 0.02
    with pytest.raises(CaptureError, match="clipped"):
        meter(OneExposure(np.full((24, 32), 1e9)), REGION, Metered(0.65), RIG)
    with pytest.raises(CaptureError, match="Expected to see the light"):
        meter(OneExposure(np.full((24, 32), 1e4)), REGION, Metered(0.65), RIG)
