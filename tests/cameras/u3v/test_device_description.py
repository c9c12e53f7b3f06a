"""The description file that the virtual camera hands out."""

from __future__ import annotations

import hashlib
import io
import struct
import zipfile

import pytest

from tests.cameras.u3v.device_host import host_of
from tests.virtual_u3v import registers as at
from tests.virtual_u3v.camera import VirtualCamera
from tests.virtual_u3v.description import description_of
from tests.virtual_u3v.faults import DescriptionFault, Faults
from tests.virtual_u3v.model import CameraModel
from tests.virtual_u3v.pixel_formats import formats_of
from tests.virtual_u3v.raw_host import RawHost


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
