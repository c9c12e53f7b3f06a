from __future__ import annotations

from dataclasses import replace

import pytest

from udccal.cameras.choice import mode_for
from udccal.cameras.protocol import Features, Range, Region, Trigger
from udccal.errors import CameraError

SENSOR = Region(0, 0, 2048, 1536)
ACE = Features(
    exposure_s=Range(2e-5, 10.0),
    gain_dB=Range(0.0, 24.0),
    frame_rate_hz=Range(0.5, 120.0),
    pixel_formats=("BayerRG8", "BayerRG12", "BayerRG12p", "YCbCr422_8"),
    triggers=(Trigger.FREE_RUN,),
    region_steps=(4, 2, 4, 2),
)


def test_the_packed_format_at_a_rate_that_the_cable_carries() -> None:
    mode = mode_for(ACE, SENSOR, "RGGB", 12)
    assert mode.pixel_format == "BayerRG12p"
    assert mode.frame_rate_hz == pytest.approx(200e6 / (2048 * 1536 * 1.5))
    unpacked = replace(ACE, pixel_formats=("BayerRG12",))
    assert mode_for(unpacked, SENSOR, "RGGB", 12).pixel_format == "BayerRG12"


def test_a_camera_that_is_slow_enough_runs_as_fast_as_it_can() -> None:
    assert mode_for(ACE, Region(0, 0, 128, 96), "RGGB", 12).frame_rate_hz is None
    assert mode_for(ACE, SENSOR, "RGGB", 12, most_bytes_per_s=1e9).frame_rate_hz is None
    assert mode_for(ACE, SENSOR, "RGGB", 12, most_bytes_per_s=1.0).frame_rate_hz == 0.5


@pytest.mark.parametrize(("cfa", "bits"), [("GBRG", 12), ("RGGB", 10), ("mono", 12)])
def test_another_sensor_than_the_rigs_is_refused(cfa: str, bits: int) -> None:
    with pytest.raises(CameraError, match=r"Expected a camera with .* found BayerRG8, .* rig\.toml"):
        mode_for(ACE, SENSOR, cfa, bits)
