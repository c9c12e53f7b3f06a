"""aravis, an independent USB3 Vision host, must accept the virtual camera."""

from __future__ import annotations

import hashlib
import re
import shutil
import subprocess
import sys
import time

import numpy as np
import pytest

from tests.usb_stack.needs import lacking
from tests.usb_stack.vhci import PlugIn
from tests.virtual_u3v.camera import VirtualCamera
from tests.virtual_u3v.clock import WallClock
from tests.virtual_u3v.model import CameraModel
from tests.virtual_u3v.sources import PATTERN_PERIOD, Exposure, PatternSource

TOOL = "arv-tool-0.8"
LIMIT_S = 60
_TRY_S = 60.0
MODEL = CameraModel()
NAME = f"udccal-{MODEL.guid}-{MODEL.serial}"


@pytest.fixture
def tool() -> str:
    if shutil.which(TOOL) is None:
        lacking(f"needs {TOOL}: apt-get install aravis-tools-cli")
    return TOOL


def check_that_it_says(command: tuple[str, ...], lines: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> str:
    """Run a program until it says all of these; what it writes is printed, for it is evidence.

    aravis waits no longer than 32 ms for a camera's first acknowledges, which on an emulated processor that is shared
    can be too short: a program may try again and again for a while.
    """
    end_s = time.monotonic() + _TRY_S
    while True:
        output = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S, check=False).stdout
        if all(line in output for line in lines) or time.monotonic() > end_s:
            break
    with capsys.disabled():
        print(f"\n$ {' '.join(command)}\n{output}", end="")
    assert [line for line in lines if line not in output] == []
    return output


def test_arv_tool_lists_reads_and_sets(plug_in: PlugIn, tool: str, capsys: pytest.CaptureFixture[str]) -> None:
    plug_in(VirtualCamera(MODEL, clock=WallClock()))
    check_that_it_says((tool,), (f"{NAME} (USB3)",), capsys)
    values = (
        "'DeviceSerialNumber' = 'V0000001'",
        "'DeviceTemperature' = 38.5 C",
        "'WidthMax' = 128",
        "'PixelFormat' = 'BayerRG8'",
        "'ExposureTime' = 7000 us",
        "'PayloadSize' = 12288",
    )
    check_that_it_says((tool, "values"), values, capsys)
    # The camera rounds down to 5 us, and the region's limits follow each other.
    wishes = ("ExposureAuto=Off", "ExposureTime=5002", "Width=64", "OffsetX=8", "Width", "PayloadSize", "Gain")
    answers = (
        "ExposureTime = 5000 us min:20 max:1e+07",
        "OffsetX = 8 min:0 max:64 inc:4",
        "Width = 64 min:8 max:120 inc:8",
        "PayloadSize = 6144",
        "Gain = 0 dB min:0 max:24",
    )
    check_that_it_says((tool, "control", *wishes), answers, capsys)


def test_arv_tool_hears_the_cameras_refusal(plug_in: PlugIn, tool: str, capsys: pytest.CaptureFixture[str]) -> None:
    plug_in(VirtualCamera(MODEL, clock=WallClock()))
    check_that_it_says((tool, "control", "Width=121"), ("invalid-parameter",), capsys)
    check_that_it_says((tool, "control", "Width"), ("Width = 128",), capsys)


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_aravis_streams_frames_bit_for_bit(
    plug_in: PlugIn, tool: str, capsys: pytest.CaptureFixture[str], mode: str
) -> None:
    plug_in(VirtualCamera(MODEL, clock=WallClock()))
    command = (sys.executable, "-m", "tests.usb_stack.aravis_stream", NAME, "8", mode)
    output = check_that_it_says(command, ("8 frames came",), capsys)
    frames = [(int(i), int(status), int(size), sha) for i, status, size, sha in re.findall(FRAME, output)]
    assert len(frames) == 8
    ids = [frame[0] for frame in frames]
    assert ids == sorted(set(ids))  # with gaps where a busy host was too slow for the camera
    assert frames == [(i, 0, 128 * 96, expected_sha1(i)) for i in ids]
    assert len({sha for *_, sha in frames}) == PATTERN_PERIOD


FRAME = r"frame (\d+) (\d+) (\d+) ([0-9a-f]{40})"


def expected_sha1(block_id: int) -> str:
    mosaic = PatternSource()(Exposure(block_id, 0, 1.0, 0, MODEL.bits, 0, 0, MODEL.columns, MODEL.rows))
    return hashlib.sha1((mosaic >> 4).astype(np.uint8).tobytes()).hexdigest()
