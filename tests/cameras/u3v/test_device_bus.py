"""The virtual camera on its bus: transfers, time, other programs, unplugging."""

from __future__ import annotations

import errno

import pytest
import usb.control
import usb.core
import usb.util

from tests.cameras.u3v.device_host import host_of, manual
from tests.virtual_u3v import registers as at
from tests.virtual_u3v.backend import VirtualBackend
from tests.virtual_u3v.camera import VirtualCamera
from tests.virtual_u3v.descriptors import CONTROL_IN, STREAM_IN
from tests.virtual_u3v.faults import Faults
from tests.virtual_u3v.raw_host import RawHost


def test_transfer_too_short_for_a_packet_overflows() -> None:
    host = host_of(VirtualCamera())
    sizes = host.start()
    host.device.read(STREAM_IN, sizes.leader, 1000)
    with pytest.raises(usb.core.USBError) as error:
        host.device.read(STREAM_IN, 1500, 1000)
    assert (error.value.errno, error.value.backend_error_code) == (errno.EOVERFLOW, -8)


def test_longer_transfers_than_agreed_run_into_the_trailer() -> None:
    """Packets are packets: only a short one ends a transfer."""
    host = host_of(VirtualCamera())
    sizes = host.start(4096)
    host.device.read(STREAM_IN, sizes.leader, 1000)
    payload = 128 * 96
    assert len(host.device.read(STREAM_IN, payload + 1024, 1000)) == payload + 32


def test_simulated_time_passes_in_no_time_and_as_it_should() -> None:
    camera = VirtualCamera()
    host = host_of(camera)
    with pytest.raises(usb.core.USBTimeoutError) as error:
        host.device.read(CONTROL_IN, 1024, 5000)
    assert (error.value.errno, error.value.backend_error_code) == (errno.ETIMEDOUT, -7)
    assert camera.clock.now_ns() == 5_000_000_000


def test_interfaces_belong_to_one_program() -> None:
    backend = VirtualBackend([VirtualCamera()])
    first, second = usb.core.find(backend=backend), usb.core.find(backend=backend)
    usb.util.claim_interface(first, 0)
    with pytest.raises(usb.core.USBError) as error:
        usb.util.claim_interface(second, 0)
    assert error.value.errno == errno.EBUSY
    usb.util.dispose_resources(first)
    usb.util.claim_interface(second, 0)


@pytest.mark.parametrize(
    ("faults", "number"), [(Faults(access_denied=True), errno.EACCES), (Faults(interface_busy=True), errno.EBUSY)]
)
def test_camera_that_may_not_be_had(faults: Faults, number: int) -> None:
    host = host_of(VirtualCamera(faults=faults))
    with pytest.raises(usb.core.USBError) as error:
        usb.util.claim_interface(host.device, 0)
    assert error.value.errno == number


def test_unplugged_camera_is_gone_and_comes_back_as_another() -> None:
    camera = VirtualCamera()
    backend = VirtualBackend([camera])
    host = RawHost(usb.core.find(backend=backend))
    manual(host)
    camera.unplug()
    assert usb.core.find(backend=backend) is None
    for action in (lambda: host.get(at.WIDTH), lambda: host.device.read(STREAM_IN, 1024, 10)):
        with pytest.raises(usb.core.USBError) as error:
            action()
        assert (error.value.errno, error.value.backend_error_code) == (errno.ENODEV, -4)
    camera.plug()
    with pytest.raises(usb.core.USBError):
        host.get(at.WIDTH)
    again = RawHost(usb.core.find(backend=backend))
    assert again.device.address != host.device.address
    assert again.get(at.EXPOSURE_AUTO) == 2
