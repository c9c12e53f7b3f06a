"""The virtual USB3 Vision camera itself, questioned byte by byte, without the driver."""

from __future__ import annotations

import errno
import hashlib
import io
import struct
import zipfile
from collections.abc import Callable

import numpy as np
import pytest
import usb.control
import usb.core
import usb.util

from tests.simulation.toy import toy_truth
from tests.virtual_u3v import registers as at
from tests.virtual_u3v.backend import VirtualBackend
from tests.virtual_u3v.camera import VirtualCamera
from tests.virtual_u3v.description import description_of
from tests.virtual_u3v.descriptors import CONTROL_IN, EVENT_IN, STREAM_IN
from tests.virtual_u3v.faults import DescriptionFault, Faults
from tests.virtual_u3v.gencp_server import PENDING_ACK
from tests.virtual_u3v.memory import Status
from tests.virtual_u3v.model import CameraModel, Speed
from tests.virtual_u3v.pixel_formats import PixelFormat, delivered, formats_of
from tests.virtual_u3v.raw_host import RawFrame, RawHost
from tests.virtual_u3v.rig_source import RigSource, model_of_rig
from tests.virtual_u3v.sources import Exposure, PatternSource
from udccal.arrangements import FlatLight
from udccal.simulation.world import SimulatedWorld


def host_of(camera: VirtualCamera) -> RawHost:
    device = usb.core.find(backend=VirtualBackend([camera]))
    assert device is not None
    return RawHost(device)


def exposure(frame: RawFrame, camera: VirtualCamera, exposure_us: float = 7000.0, gain_steps: int = 0) -> Exposure:
    columns, rows, x, y = struct.unpack_from("<4I", frame.leader, 32)
    block_id = frame.block_ids[0]
    return Exposure(block_id, frame.timestamp_ns, exposure_us, gain_steps, camera.model.bits, x, y, columns, rows)


def unpacked(data: bytes, pixel_format: PixelFormat, shape: tuple[int, int]) -> np.ndarray:
    """Samples bit by bit, little endian, for formats of any width: slow and obvious."""
    bits = np.unpackbits(np.frombuffer(data, np.uint8), bitorder="little").reshape(-1, pixel_format.bits_per_pixel)
    return (bits @ (1 << np.arange(pixel_format.bits_per_pixel))).astype(np.uint16).reshape(shape)


def manual(host: RawHost) -> None:
    """Switch the automatics off, so that frames are the same each time."""
    assert [host.set(register, 0) for register in (at.EXPOSURE_AUTO, at.GAIN_AUTO)] == [0, 0]


# Descriptors


def test_descriptors_are_those_of_a_usb3_vision_camera() -> None:
    device = host_of(VirtualCamera()).device
    assert (device.bDeviceClass, device.bDeviceSubClass, device.bDeviceProtocol) == (0xEF, 0x02, 0x01)
    interfaces = list(device.get_active_configuration())
    kinds = [(i.bInterfaceClass, i.bInterfaceSubClass, i.bInterfaceProtocol) for i in interfaces]
    assert kinds == [(0xEF, 5, 0), (0xEF, 5, 1), (0xEF, 5, 2)]
    endpoints = [[e.bEndpointAddress for e in i] for i in interfaces]
    assert endpoints == [[0x01, CONTROL_IN], [EVENT_IN], [STREAM_IN]]
    assert (device.manufacturer, device.product, device.serial_number) == ("udccal", "Virtual-U3V", "V0000001")


def test_device_info_descriptor_and_association_are_in_their_places() -> None:
    device = host_of(VirtualCamera()).device
    configuration = device.get_active_configuration()
    assert list(configuration.extra_descriptors) == [8, 11, 0, 3, 0xEF, 5, 0, 0]
    info = bytes(configuration[(0, 0)].extra_descriptors)
    length, kind, subtype, gencp_minor, gencp_major, u3v_minor, u3v_major = struct.unpack_from("<BBBHHHH", info)
    assert (length, kind, subtype) == (len(info), 0x24, 1)
    assert (gencp_major, gencp_minor, u3v_major, u3v_minor) == (1, 1, 1, 0)
    assert usb.util.get_string(device, info[11]).startswith("1209")
    assert usb.util.get_string(device, info[17]) == "V0000001"
    assert info[19] == 0b1100


def test_total_length_counts_every_byte() -> None:
    descriptors = VirtualCamera().descriptors
    raw = descriptors.configuration.to_bytes()
    assert struct.unpack_from("<H", raw, 2)[0] == len(raw)
    lengths, place = [], 0
    while place < len(raw):
        lengths.append(raw[place])
        place += raw[place]
    assert place == len(raw)
    assert lengths == [9, 8, 9, 20, 7, 6, 7, 6, 9, 7, 6, 9, 7, 6]


@pytest.mark.parametrize(("speed", "packet", "bit"), [(Speed.SUPER, 1024, 8), (Speed.HIGH, 512, 4)])
def test_speed_of_the_link_is_told(speed: Speed, packet: int, bit: int) -> None:
    host = host_of(VirtualCamera(speed=speed))
    assert host.device.speed == speed
    assert host.device[0][(2, 0)][0].wMaxPacketSize == packet
    assert host.get(at.CURRENT_SPEED) == bit


def test_camera_without_events_has_two_interfaces() -> None:
    host = host_of(VirtualCamera(CameraModel(event_interface=False)))
    assert [i.bInterfaceProtocol for i in host.device.get_active_configuration()] == [0, 2]
    assert host.get(at.U3VCP_CAPABILITY) == 1


# Control channel


def test_bootstrap_registers_say_who_it_is() -> None:
    host = host_of(VirtualCamera())
    assert host.readmem(0x144, 64).data.rstrip(b"\0") == b"V0000001"
    assert host.readmem(0x004, 64).data.rstrip(b"\0") == b"udccal"
    assert host.get(at.GENCP_VERSION) == 0x00010001
    assert (host.get(at.SBRM_ADDRESS), host.get(at.SIRM_ADDRESS)) == (at.SBRM, at.SIRM)


def test_user_defined_name_is_kept_until_the_power_goes() -> None:
    camera = VirtualCamera()
    host = host_of(camera)
    assert host.writemem(0x184, b"left one".ljust(64, b"\0")).status == 0
    assert host.readmem(0x184, 8).data == b"left one"
    camera.unplug()
    camera.plug()
    assert host_of(camera).readmem(0x184, 8).data == bytes(8)


@pytest.mark.parametrize(
    ("ask", "status"),
    [
        (lambda h: h.readmem(0x0900_0000, 4), Status.INVALID_ADDRESS),
        (lambda h: h.readmem(at.FEATURES + 0xFFC, 8), Status.INVALID_ADDRESS),
        (lambda h: h.readmem(0, 1013), Status.INVALID_PARAMETER),
        (lambda h: h.readmem(at.ACQUISITION_START.address, 4), Status.ACCESS_DENIED),
        (lambda h: h.writemem(0x144, bytes(64)), Status.WRITE_PROTECT),
        (lambda h: h.writemem(at.WIDTH.address, bytes(2)), Status.BAD_ALIGNMENT),
        (lambda h: h.writemem(at.WIDTH.address + 4, bytes(2)), Status.BAD_ALIGNMENT),
        (lambda h: h.ask(0x0806, bytes(4)), Status.NOT_IMPLEMENTED),
        (lambda h: h.ask(0x0800, bytes(4)), Status.INVALID_HEADER),
    ],
)
def test_refuses_what_it_should(ask: Callable[[RawHost], object], status: Status) -> None:
    ack = ask(host_of(VirtualCamera()))
    assert (ack.status, ack.data) == (status, b"")


def test_command_whose_length_lies_is_refused() -> None:
    host = host_of(VirtualCamera())
    host.send(0x0800, bytes(12), length=13)
    assert host.acknowledge().status == Status.INVALID_HEADER


def test_command_that_wants_no_acknowledge_gets_none() -> None:
    host = host_of(VirtualCamera())
    host.send(0x0802, struct.pack("<QI", at.EXPOSURE_AUTO.address, 0), flags=0)
    with pytest.raises(usb.core.USBTimeoutError):
        host.acknowledge()
    assert host.get(at.EXPOSURE_AUTO) == 0


@pytest.mark.parametrize(
    ("register", "value", "status"),
    [
        (at.WIDTH, 120, Status.SUCCESS),
        (at.WIDTH, 121, Status.INVALID_PARAMETER),
        (at.WIDTH, 136, Status.INVALID_PARAMETER),
        (at.OFFSET_X, 4, Status.INVALID_PARAMETER),  # no room beside the full width
        (at.HEIGHT, 0, Status.INVALID_PARAMETER),
        (at.PIXEL_FORMAT, 0x01080001, Status.INVALID_PARAMETER),  # Mono8 of a colour sensor
        (at.PIXEL_FORMAT, 0x010C0059, Status.SUCCESS),
        (at.EXPOSURE_TIME_RAW, 50_000, Status.ACCESS_DENIED),  # the automatic has it
        (at.GAIN_RAW, 10, Status.ACCESS_DENIED),
        (at.TRIGGER_SOURCE, 2, Status.INVALID_PARAMETER),
        (at.SI_PAYLOAD_TRANSFER_SIZE, 1000, Status.PAYLOAD_SIZE_NOT_ALIGNED),
        (at.SI_CONTROL, 1, Status.STREAM_REGISTERS_INCONSISTENT),
    ],
)
def test_features_have_limits(register: at.Register, value: int, status: Status) -> None:
    assert host_of(VirtualCamera()).set(register, value) == status


def test_exposure_is_rounded_down_without_a_word() -> None:
    host = host_of(VirtualCamera())
    manual(host)
    assert host.set(at.EXPOSURE_TIME_RAW, 40_034) == 0
    assert host.get(at.EXPOSURE_TIME_RAW) == 40_000
    assert host.set(at.EXPOSURE_TIME_RAW, 199) == Status.INVALID_PARAMETER


def test_nothing_changes_while_frames_are_taken() -> None:
    host = host_of(VirtualCamera())
    host.start()
    refused = [host.set(r, host.get(r)) for r in (at.WIDTH, at.PIXEL_FORMAT, at.SI_PAYLOAD_TRANSFER_SIZE)]
    assert refused == [Status.ACCESS_DENIED] * 3
    host.stop()
    assert host.set(at.WIDTH, 64) == 0


def test_event_interface_sends_its_test_event_when_switched_on() -> None:
    host = host_of(VirtualCamera())
    assert host.set(at.EI_EVENT_TEST_CONTROL, 1) == Status.ACCESS_DENIED
    assert host.set(at.EI_CONTROL, 1) == 0
    assert host.set(at.EI_EVENT_TEST_CONTROL, 1) == 0
    event = bytes(host.device.read(EVENT_IN, 1024, 1000))
    assert event[:4] == b"U3VE"
    assert struct.unpack_from("<HHH", event, 6)[0] == 0x0C00
    assert struct.unpack_from("<H", event, 14)[0] == 0x4FFF


# Description


def manifest(host: RawHost) -> tuple[int, int, int, bytes]:
    """Entries, size and kind of the first file, and its SHA-1."""
    table = host.readmem(host.get(at.MANIFEST_TABLE_ADDRESS), 72).data
    entries, _, kind, _, size = struct.unpack_from("<QIIQQ", table)
    return entries, size, kind >> 10 & 0x3F, table[32:52]


def file_of(host: RawHost) -> bytes:
    _, size, _, _ = manifest(host)
    starts = range(0, size, 1000)
    return b"".join(host.readmem(at.DESCRIPTION + start, min(1000, size - start)).data for start in starts)


def test_description_comes_out_of_the_camera_as_it_went_in() -> None:
    host = host_of(VirtualCamera())
    entries, size, kind, digest = manifest(host)
    data = file_of(host)
    assert (entries, size, kind) == (1, len(data), 1)
    assert hashlib.sha1(data).digest() == digest
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        assert archive.read(archive.namelist()[0]).decode() == description_of(CameraModel())


def test_spoilt_descriptions_are_spoilt() -> None:
    def camera(fault: DescriptionFault) -> RawHost:
        return host_of(VirtualCamera(faults=Faults(description=fault)))

    assert manifest(camera(DescriptionFault.NO_ENTRIES))[0] == 0
    assert manifest(camera(DescriptionFault.ENDLESS_MANIFEST))[0] == 1 << 63
    assert manifest(camera(DescriptionFault.HUGE_SIZE))[1] == 1 << 40
    assert manifest(camera(DescriptionFault.UNCOMPRESSED))[2] == 0
    wrong = camera(DescriptionFault.WRONG_SHA1)
    assert hashlib.sha1(file_of(wrong)).digest() != manifest(wrong)[3]
    damaged = camera(DescriptionFault.DAMAGED_ZIP)
    assert hashlib.sha1(file_of(damaged)).digest() == manifest(damaged)[3]
    with pytest.raises((zipfile.BadZipFile, zipfile.zlib.error)), zipfile.ZipFile(io.BytesIO(file_of(damaged))) as a:
        a.read(a.namelist()[0])
    assert zipfile.ZipFile(io.BytesIO(file_of(camera(DescriptionFault.ZIP_BOMB)))).infolist()[0].file_size == 1 << 27


def test_emvas_genapi_loads_the_description_and_converts() -> None:
    genapi = pytest.importorskip("genicam.genapi", reason="needs genicam: pip install genicam")
    host = host_of(VirtualCamera())

    class Port(genapi.AbstractPort):
        def read(self, address: int, length: int) -> bytes:
            return host.readmem(address, length).data

        def write(self, address: int, data: bytes) -> None:
            assert host.writemem(address, bytes(data)).status == 0

        def get_access_mode(self) -> int:
            return genapi.EAccessMode.RW

    nodes, port = genapi.NodeMap(), Port()
    nodes.load_xml_from_string(description_of(CameraModel()))
    nodes.connect(port, "Device")
    assert nodes.DeviceSerialNumber.value == "V0000001"
    assert nodes.DeviceTemperature.value == pytest.approx(38.5)
    assert nodes.PixelFormat.symbolics == tuple(f.name for f in formats_of(CameraModel()))
    assert nodes.ExposureTime.node.get_access_mode() == genapi.EAccessMode.RO
    nodes.ExposureAuto.value = "Off"
    nodes.ExposureTime.value = 4000.0
    assert host.get(at.EXPOSURE_TIME_RAW) == 40_000
    assert (nodes.ExposureTime.min, nodes.ExposureTime.max) == pytest.approx((20.0, 1e7))
    nodes.Width.value = 64
    assert (nodes.WidthMax.value, nodes.OffsetX.max, nodes.OffsetX.inc) == (128, 64, 4)
    nodes.OffsetX.value = 8
    assert (nodes.WidthMax.value, nodes.Width.max, nodes.PayloadSize.value) == (128, 120, 64 * 96)
    assert nodes.AcquisitionFrameRate.max == pytest.approx(120.0)


# Streaming


@pytest.mark.parametrize("pixel_format", formats_of(CameraModel()), ids=lambda f: f.name)
def test_frames_are_what_the_source_made(pixel_format: PixelFormat) -> None:
    camera = VirtualCamera()
    host = host_of(camera)
    host.set(at.PIXEL_FORMAT, pixel_format.code)
    sizes = host.start(8192)
    for block_id in range(6):
        frame = host.frame(sizes)
        assert frame.block_ids == (block_id, block_id)
        assert struct.unpack_from("<H", frame.leader, 18)[0] == 0x0001
        assert struct.unpack_from("<I", frame.leader, 28)[0] == pixel_format.code
        mosaic = PatternSource()(exposure(frame, camera))
        expected = delivered(mosaic, camera.model.bits, pixel_format.bits)
        np.testing.assert_array_equal(unpacked(frame.payload, pixel_format, mosaic.shape), expected)


def test_pattern_tells_places_and_frames_apart() -> None:
    source = PatternSource()
    whole = source(Exposure(0, 0, 1.0, 0, 12, 0, 0, 128, 96))
    part = source(Exposure(0, 0, 1.0, 0, 12, 8, 4, 64, 48))
    later = source(Exposure(1, 0, 1.0, 0, 12, 0, 0, 128, 96))
    np.testing.assert_array_equal(part, whole[4:52, 8:72])
    assert (whole == later).mean() < 0.01
    assert (whole[:, 1:] == whole[:, :-1]).mean() < 0.01
    assert whole.max() > 4000


def test_region_and_times_are_in_the_leader() -> None:
    camera = VirtualCamera()
    host = host_of(camera)
    manual(host)
    for register, value in ((at.WIDTH, 64), (at.HEIGHT, 48), (at.OFFSET_X, 8), (at.OFFSET_Y, 4)):
        assert host.set(register, value) == 0
    sizes = host.start()
    frames = [host.frame(sizes) for _ in range(3)]
    assert struct.unpack_from("<4I", frames[0].leader, 32) == (64, 48, 8, 4)
    np.testing.assert_allclose(np.diff([f.timestamp_ns for f in frames]), 1e9 / 120, atol=1)
    assert len(frames[0].payload) == 64 * 48


def test_frames_of_a_simulated_rig_are_the_rigs() -> None:
    def world() -> SimulatedWorld:
        made = SimulatedWorld(toy_truth(), seed=3)
        made.arrange(FlatLight())
        return made

    camera = VirtualCamera(model_of_rig(world()), RigSource(world()))
    host = host_of(camera)
    manual(host)
    host.set(at.PIXEL_FORMAT, next(f.code for f in formats_of(camera.model) if f.name.endswith("12")))
    frame = host.frame(host.start())
    settings = exposure(frame, camera, gain_steps=host.get(at.GAIN_RAW)).settings
    expected = world().develop(world().rate_during(settings, 0.0), settings, 0)
    np.testing.assert_array_equal(np.frombuffer(frame.payload, "<u2").reshape(expected.shape), expected)


def test_chunks_say_what_the_frame_was_taken_with() -> None:
    host = host_of(VirtualCamera())
    assert [host.set(r, 1) for r in (at.CHUNK_MODE_ACTIVE, *at.CHUNK_ENABLE)] == [0] * 6
    sizes = host.start()
    exposures = []
    for _ in range(3):
        frame = host.frame(sizes)
        assert struct.unpack_from("<H", frame.leader, 18)[0] == 0x4001
        values, rest = {}, frame.payload
        while rest:
            identifier, length = struct.unpack("<II", rest[-8:])
            values[identifier] = rest[-8 - length : -8]
            rest = rest[: -8 - length]
        assert len(values[1]) == 128 * 96
        exposures.append(struct.unpack("<d", values[0xA001])[0])
        assert struct.unpack("<Q", values[0xA003])[0] == frame.timestamp_ns
        assert struct.unpack("<Q", values[0xA004])[0] == frame.block_ids[0]
    assert exposures == [7000.0, 7050.0, 7100.0]  # the automatic is still on


def test_waits_for_its_triggers() -> None:
    camera = VirtualCamera()
    host = host_of(camera)
    host.set(at.TRIGGER_MODE, 1)
    sizes = host.start()
    with pytest.raises(usb.core.USBTimeoutError):
        host.frame(sizes)
    assert host.set(at.TRIGGER_SOFTWARE, 1) == 0
    assert host.frame(sizes).block_ids[0] == 0
    with pytest.raises(usb.core.USBTimeoutError):
        host.frame(sizes)
    assert host.set(at.TRIGGER_SOURCE, 1) == 0
    assert host.set(at.TRIGGER_SOFTWARE, 1) == Status.ACCESS_DENIED
    camera.pulse()
    assert host.frame(sizes).block_ids[0] == 1


def test_takes_as_many_frames_as_asked() -> None:
    host = host_of(VirtualCamera())
    host.set(at.ACQUISITION_MODE, 2)
    host.set(at.ACQUISITION_FRAME_COUNT, 3)
    sizes = host.start()
    assert [host.frame(sizes).block_ids[0] for _ in range(3)] == [0, 1, 2]
    with pytest.raises(usb.core.USBTimeoutError):
        host.frame(sizes)


def test_frame_rate_is_kept_when_asked_for() -> None:
    host = host_of(VirtualCamera())
    host.writemem(at.ACQUISITION_FRAME_RATE.address, struct.pack("<d", 10.0))
    host.set(at.ACQUISITION_FRAME_RATE_ENABLE, 1)
    sizes = host.start()
    times = [host.frame(sizes).timestamp_ns for _ in range(3)]
    np.testing.assert_allclose(np.diff(times), 1e8, atol=1)


# The bus


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


# Faults of the control channel


def test_pending_acknowledges_come_first_and_take_their_time() -> None:
    camera = VirtualCamera(faults=Faults(pending_acks=2, pending_ms=1000))
    host = host_of(camera)
    host.send(0x0800, struct.pack("<QHH", 0, 0, 4))
    first, second = host.acknowledge(200), host.acknowledge(1000)
    assert [(a.command, a.request_id) for a in (first, second)] == [(PENDING_ACK, 1)] * 2
    assert struct.unpack("<HH", first.data) == (0, 1000)
    with pytest.raises(usb.core.USBTimeoutError):
        host.acknowledge(200)
    assert host.acknowledge(1000).command == 0x0801
    assert host.get(at.GENCP_VERSION) == 0x00010001


def test_stale_acknowledge_comes_before_the_right_one() -> None:
    camera = VirtualCamera()
    host = host_of(camera)
    host.get(at.GENCP_VERSION)
    camera.inject(Faults(stale_acks=1))
    assert [host.readmem(0x1CC, 4).request_id, host.acknowledge().request_id] == [1, 2]


def test_lost_acknowledge_never_comes_though_the_command_was_done() -> None:
    camera = VirtualCamera(faults=Faults(lost_acks=1))
    host = host_of(camera)
    with pytest.raises(usb.core.USBTimeoutError):
        host.set(at.EXPOSURE_AUTO, 0)
    assert host.get(at.EXPOSURE_AUTO) == 0


def test_late_acknowledge_meets_the_next_command() -> None:
    host = host_of(VirtualCamera(faults=Faults(late_acks=1, late_ms=1500)))
    with pytest.raises(usb.core.USBTimeoutError):
        host.readmem(0, 4)
    assert [host.readmem(0, 4).request_id, host.acknowledge().request_id] == [1, 2]


@pytest.mark.parametrize(
    ("faults", "field", "found"),
    [
        (Faults(wrong_ack_ids=1), "request_id", 78),
        (Faults(wrong_ack_commands=1), "command", 0x0803),
        (Faults(garbled_acks=1), "prefix", 0xDEADBEEF),
        (Faults(bad_statuses=1, status=Status.BUSY), "status", Status.BUSY),
    ],
)
def test_spoilt_acknowledges(faults: Faults, field: str, found: int) -> None:
    host = host_of(VirtualCamera(faults=faults))
    assert getattr(host.readmem(0, 4), field) == found
    assert (host.readmem(0, 4).request_id, host.readmem(0, 4).status) == (2, 0)


def test_short_acknowledge_is_cut_in_its_header() -> None:
    host = host_of(VirtualCamera(faults=Faults(short_acks=1)))
    host.send(0x0800, struct.pack("<QHH", 0, 0, 4))
    assert len(host.device.read(CONTROL_IN, 1024, 1000)) == 6


def test_refused_command_is_not_carried_out() -> None:
    host = host_of(VirtualCamera(faults=Faults(bad_statuses=1)))
    assert host.set(at.EXPOSURE_AUTO, 0) == Status.BUSY
    assert host.get(at.EXPOSURE_AUTO) == 2


def test_control_halt_lasts_until_cleared() -> None:
    host = host_of(VirtualCamera(faults=Faults(control_halts=1)))
    for _ in range(2):
        with pytest.raises(usb.core.USBError) as error:
            host.readmem(0, 4)
        assert (error.value.errno, error.value.backend_error_code) == (errno.EPIPE, -9)
    host.device.clear_halt(CONTROL_IN)
    assert host.acknowledge().request_id == 2


def test_slow_camera_takes_its_time() -> None:
    camera = VirtualCamera(faults=Faults(response_ms=150))
    host_of(camera).get(at.GENCP_VERSION)
    assert camera.clock.now_ns() == 150_000_000


def test_unplug_during_a_command() -> None:
    camera = VirtualCamera(faults=Faults(unplug_at_command=1))
    host = host_of(camera)
    host.get(at.GENCP_VERSION)
    with pytest.raises(usb.core.USBError) as error:
        host.get(at.GENCP_VERSION)
    assert error.value.errno == errno.ENODEV
    assert not camera.plugged


# Faults of the stream


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
