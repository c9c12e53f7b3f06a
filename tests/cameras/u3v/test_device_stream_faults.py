"""Faults of the virtual camera's stream are what they are called."""

from __future__ import annotations

import errno

import pytest
import usb.control
import usb.core
import usb.util

from tests.cameras.u3v.device_host import host_of
from tests.virtual_u3v import registers as at
from tests.virtual_u3v.camera import VirtualCamera
from tests.virtual_u3v.descriptors import STREAM_IN
from tests.virtual_u3v.faults import Faults
from tests.virtual_u3v.memory import Status
from tests.virtual_u3v.raw_host import RawFrame, RawHost


def streamed(faults: Faults, transfer: int = 4096) -> tuple[VirtualCamera, RawHost, list[RawFrame]]:
    """Frames 0 and 1 of a camera with these faults, read as agreed."""
    camera = VirtualCamera(faults=faults)
    host = host_of(camera)
    sizes = host.start(transfer)
    return camera, host, [host.frame(sizes) for _ in range(2)]


def order(faults: Faults, reads: int) -> str:
    """What comes, transfer by transfer: L leader, T trailer, d data, of which there are three to a frame."""
    host = host_of(VirtualCamera(faults=faults))
    host.start(4096)
    starts = [bytes(host.device.read(STREAM_IN, 4096, 1000))[:4] for _ in range(reads)]
    return "".join({b"U3VL": "L", b"U3VT": "T"}.get(start, "d") for start in starts)


def test_missing_leader_and_trailer_are_missing() -> None:
    assert order(Faults(), 10) == "LdddTLdddT"
    assert order(Faults(missing_leaders=(0,)), 9) == "dddTLdddT"
    assert order(Faults(missing_trailers=(0,)), 9) == "LdddLdddT"


def test_wrong_block_id_is_in_the_trailer_of_its_frame_alone() -> None:
    _, _, frames = streamed(Faults(wrong_block_ids=(1,)))
    assert [f.block_ids for f in frames] == [(0, 0), (1, 1001)]


def test_dropped_frames_leave_a_gap_and_duplicates_none() -> None:
    assert [f.block_ids[0] for f in streamed(Faults(dropped_frames=(0, 2)))[2]] == [1, 3]
    twice = streamed(Faults(duplicated_frames=(0,)))[2]
    assert [f.block_ids[0] for f in twice] == [0, 0]
    assert twice[0] == twice[1]


def test_short_frame_says_so_and_lying_frame_does_not() -> None:
    for faults, status, size in (
        (Faults(short_frames=(0,)), Status.DATA_DISCARDED, 128 * 48),
        (Faults(lying_frames=(0,)), Status.SUCCESS, 128 * 96),
    ):
        host = host_of(VirtualCamera(faults=faults))
        host.start(16384)
        leader, payload, trailer = (bytes(host.device.read(STREAM_IN, 16384, 1000)) for _ in range(3))
        frame = RawFrame(leader, payload, trailer)
        assert (len(payload), frame.status, frame.valid_payload_size) == (128 * 48, status, size)


def test_long_frame_runs_over() -> None:
    host = host_of(VirtualCamera(faults=Faults(long_frames=(0,))))
    sizes = host.start(4096)
    frame = host.frame(sizes)
    assert (frame.leader[:4], len(frame.payload)) == (b"U3VL", 128 * 96)
    assert frame.trailer == b"\xee" * 1024


@pytest.mark.parametrize(
    ("faults", "number"),
    [
        (Faults(stream_halts=(1,)), errno.EPIPE),
        (Faults(babble_frames=(1,)), errno.EOVERFLOW),
        (Faults(unplug_at_frame=1), errno.ENODEV),
        (Faults(hang_at_frame=1), errno.ETIMEDOUT),
    ],
)
def test_frame_breaks_off(faults: Faults, number: int) -> None:
    camera = VirtualCamera(faults=faults)
    host = host_of(camera)
    sizes = host.start(4096)
    assert host.frame(sizes).block_ids == (0, 0)
    with pytest.raises(usb.core.USBError) as error:
        host.frame(sizes)
    assert error.value.errno == number
    assert camera.plugged == (number != errno.ENODEV)


def test_halted_stream_goes_on_with_the_next_frame_when_cleared() -> None:
    camera = VirtualCamera(faults=Faults(stream_halts=(0,)))
    host = host_of(camera)
    sizes = host.start(4096)
    with pytest.raises(usb.core.USBError):
        host.frame(sizes)
    host.stop()
    assert host.set(at.SI_CONTROL, 1) == Status.STREAM_ENDPOINT_HALTED
    host.device.clear_halt(STREAM_IN)
    sizes = host.start(4096)
    assert host.frame(sizes).block_ids == (0, 0)


def test_host_empties_the_stream_by_halting_it() -> None:
    host = host_of(VirtualCamera())
    sizes = host.start(4096)
    host.device.read(STREAM_IN, sizes.leader, 1000)
    usb.control.set_feature(host.device, usb.control.ENDPOINT_HALT, host.device[0][(2, 0)][0])
    with pytest.raises(usb.core.USBError) as error:
        host.device.read(STREAM_IN, 4096, 1000)
    assert error.value.errno == errno.EPIPE
    host.device.clear_halt(STREAM_IN)
    assert host.frame(sizes).block_ids == (1, 1)


def test_hung_camera_stays_silent() -> None:
    _, host, _ = streamed(Faults(hang_at_frame=2))
    host.device.read(STREAM_IN, 1024, 1000)
    host.device.read(STREAM_IN, 4096, 1000)
    for _ in range(2):
        with pytest.raises(usb.core.USBTimeoutError):
            host.device.read(STREAM_IN, 4096, 1000)
