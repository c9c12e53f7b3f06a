"""The virtual camera's own GenICam description: SFNC 2.x names on its registers."""

from __future__ import annotations

import io
import zipfile

from tests.virtual_u3v import registers as at
from tests.virtual_u3v import xml_nodes as xml
from tests.virtual_u3v.chunks import CHUNKS
from tests.virtual_u3v.model import CameraModel
from tests.virtual_u3v.pixel_formats import formats_of
from tests.virtual_u3v.xml_nodes import Entry

XML_NAME = "virtual_u3v.xml"
AUTO = (Entry("Off", 0), Entry("Once", 1), Entry("Continuous", 2))
ACQUISITION_MODES = (Entry("Continuous", 0), Entry("SingleFrame", 1), Entry("MultiFrame", 2))
TRIGGER_SOURCES = (Entry("Software", 0), Entry("Line1", 1))
_ON_OFF = (Entry("Off", 0), Entry("On", 1))


def zipped(text: str) -> bytes:
    """A description in a zip file with this one member, as USB3 Vision 1.0 §4.3 has it."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(zipfile.ZipInfo(XML_NAME), text)
    return buffer.getvalue()


def description_of(model: CameraModel) -> str:
    """The description of a camera."""
    head = (
        '<?xml version="1.0" encoding="utf-8"?>\n'
        f'<RegisterDescription ModelName="{model.model.replace("-", "_")}" VendorName="{model.vendor}" '
        'ToolTip="A simulated USB3 Vision camera" StandardNameSpace="None" '
        'SchemaMajorVersion="1" SchemaMinorVersion="1" SchemaSubMinorVersion="0" '
        'MajorVersion="1" MinorVersion="0" SubMinorVersion="0" '
        'ProductGuid="5E1DD0C1-98A4-4E5A-9E4B-0C9B2E6C4A11" VersionGuid="A3C4BC1E-7B4E-4F37-8B2A-3C0E5C1F7D52" '
        'xmlns="http://www.genicam.org/GenApi/Version_1_1">\n'
    )
    parts = (_categories(model), _device(model), _format(model), _analog(model), _acquisition(model), _transport())
    return head + "".join(parts) + (_chunks() if model.chunks else "") + "</RegisterDescription>\n"


def _categories(model: CameraModel) -> str:
    names = ["DeviceControl", "ImageFormatControl", "AnalogControl", "AcquisitionControl", "TransportLayerControl"]
    device = ("DeviceVendorName", "DeviceModelName", "DeviceFamilyName", "DeviceVersion", "DeviceManufacturerInfo")
    warmth = ("DeviceTemperature",) if model.temperature else ()
    size = ("SensorWidth", "SensorHeight", "WidthMax", "HeightMax", "Width", "Height", "OffsetX", "OffsetY")
    trigger = ("TriggerSelector", "TriggerMode", "TriggerSource", "TriggerSoftware")
    rate = ("AcquisitionFrameRateEnable", "AcquisitionFrameRate", "ExposureAuto", "ExposureTime")
    acquisition = ("AcquisitionMode", "AcquisitionFrameCount", "AcquisitionStart", "AcquisitionStop", *rate, *trigger)
    parts = [
        xml.category("DeviceControl", *device, "DeviceSerialNumber", "DeviceUserID", *warmth),
        xml.category("ImageFormatControl", *size, "PixelFormat"),
        xml.category("AnalogControl", "GainAuto", "Gain"),
        xml.category("AcquisitionControl", *acquisition),
        xml.category("TransportLayerControl", "PayloadSize", "TLParamsLocked"),
    ]
    if model.chunks:
        names.append("ChunkDataControl")
        values = tuple(chunk.feature for chunk in CHUNKS if chunk.feature)
        parts.append(xml.category("ChunkDataControl", "ChunkModeActive", "ChunkSelector", "ChunkEnable", *values))
    return xml.category("Root", *names) + "".join(parts)


def _device(model: CameraModel) -> str:
    warmth = xml.formula("SwissKnife", "DeviceTemperature", "TemperatureRaw / 16.0", "TemperatureRaw", unit="C")
    warmth += xml.register("TemperatureRaw", at.TEMPERATURE_RAW, cached=False, signed=True)
    return (
        xml.string_register("DeviceVendorName", at.MANUFACTURER_NAME)
        + xml.string_register("DeviceModelName", at.MODEL_NAME)
        + xml.string_register("DeviceFamilyName", at.FAMILY_NAME)
        + xml.string_register("DeviceVersion", at.DEVICE_VERSION)
        + xml.string_register("DeviceManufacturerInfo", at.MANUFACTURER_INFO)
        + xml.string_register("DeviceSerialNumber", at.SERIAL_NUMBER)
        + xml.string_register("DeviceUserID", at.USER_DEFINED_NAME)
        + (warmth if model.temperature else "")
    )


def _format(model: CameraModel) -> str:
    step_x, step_y = model.offset_step
    wide, high = model.size_step
    entries = tuple(Entry(pixel_format.name, pixel_format.code) for pixel_format in formats_of(model))
    parts = (
        xml.register("SensorWidth", at.SENSOR_WIDTH),
        xml.register("SensorHeight", at.SENSOR_HEIGHT),
        xml.formula("IntSwissKnife", "WidthMax", "SensorWidth", "SensorWidth"),
        xml.formula("IntSwissKnife", "HeightMax", "SensorHeight", "SensorHeight"),
        xml.formula("IntSwissKnife", "WidthLimit", "SensorWidth - OffsetXReg", "SensorWidth", "OffsetXReg"),
        xml.formula("IntSwissKnife", "HeightLimit", "SensorHeight - OffsetYReg", "SensorHeight", "OffsetYReg"),
        xml.formula("IntSwissKnife", "OffsetXMax", "SensorWidth - WidthReg", "SensorWidth", "WidthReg"),
        xml.formula("IntSwissKnife", "OffsetYMax", "SensorHeight - HeightReg", "SensorHeight", "HeightReg"),
        xml.integer("Width", "WidthReg", ("Min", wide), ("pMax", "WidthLimit"), ("Inc", wide), locked=True),
        xml.integer("Height", "HeightReg", ("Min", high), ("pMax", "HeightLimit"), ("Inc", high), locked=True),
        xml.integer("OffsetX", "OffsetXReg", ("Min", 0), ("pMax", "OffsetXMax"), ("Inc", step_x), locked=True),
        xml.integer("OffsetY", "OffsetYReg", ("Min", 0), ("pMax", "OffsetYMax"), ("Inc", step_y), locked=True),
        xml.register("WidthReg", at.WIDTH),
        xml.register("HeightReg", at.HEIGHT),
        xml.register("OffsetXReg", at.OFFSET_X),
        xml.register("OffsetYReg", at.OFFSET_Y),
        xml.enumeration("PixelFormat", "PixelFormatReg", *entries, locked=True),
        xml.register("PixelFormatReg", at.PIXEL_FORMAT),
    )
    return "".join(parts)


def _analog(model: CameraModel) -> str:
    return (
        xml.enumeration("GainAuto", "GainAutoReg", *AUTO)
        + xml.register("GainAutoReg", at.GAIN_AUTO)
        + xml.converter("Gain", "GainRaw", 0.1, "dB", "GainAutoReg")
        + xml.integer("GainRaw", "GainReg", ("Min", 0), ("Max", model.gain_steps), ("Inc", 1))
        + xml.register("GainReg", at.GAIN_RAW)
    )


def _acquisition(model: CameraModel) -> str:
    shortest, longest = (round(10 * limit) for limit in model.exposure_us)
    fastest = f"(ExposureReg > {1e7 / model.frame_rate_hz[1]}) ? (10000000.0 / ExposureReg) : {model.frame_rate_hz[1]}"
    parts = (
        xml.enumeration("AcquisitionMode", "AcquisitionModeReg", *ACQUISITION_MODES, locked=True),
        xml.register("AcquisitionModeReg", at.ACQUISITION_MODE),
        xml.integer("AcquisitionFrameCount", "FrameCountReg", ("Min", 1), ("Max", 65535)),
        xml.register("FrameCountReg", at.ACQUISITION_FRAME_COUNT),
        xml.command("AcquisitionStart", "AcquisitionStartReg"),
        xml.register("AcquisitionStartReg", at.ACQUISITION_START),
        xml.command("AcquisitionStop", "AcquisitionStopReg"),
        xml.register("AcquisitionStopReg", at.ACQUISITION_STOP),
        xml.enumeration("ExposureAuto", "ExposureAutoReg", *AUTO),
        xml.register("ExposureAutoReg", at.EXPOSURE_AUTO),
        xml.converter("ExposureTime", "ExposureTimeRaw", 0.1, "us", "ExposureAutoReg"),
        xml.integer("ExposureTimeRaw", "ExposureReg", ("Min", shortest), ("Max", longest), ("Inc", 1)),
        xml.register("ExposureReg", at.EXPOSURE_TIME_RAW),
        xml.boolean("AcquisitionFrameRateEnable", "FrameRateEnableReg"),
        xml.register("FrameRateEnableReg", at.ACQUISITION_FRAME_RATE_ENABLE),
        xml.node(
            "Float",
            "AcquisitionFrameRate",
            ("pValue", "FrameRateReg"),
            ("Min", model.frame_rate_hz[0]),
            ("pMax", "FrameRateMax"),
            ("Unit", "Hz"),
        ),
        xml.double_register("FrameRateReg", at.ACQUISITION_FRAME_RATE),
        xml.formula("SwissKnife", "FrameRateMax", fastest, "ExposureReg", unit="Hz"),
        xml.enumeration("TriggerSelector", "TriggerSelectorValue", Entry("FrameStart", 0)),
        xml.node("Integer", "TriggerSelectorValue", ("Value", 0)),
        xml.enumeration("TriggerMode", "TriggerModeReg", *_ON_OFF),
        xml.register("TriggerModeReg", at.TRIGGER_MODE),
        xml.enumeration("TriggerSource", "TriggerSourceReg", *TRIGGER_SOURCES),
        xml.register("TriggerSourceReg", at.TRIGGER_SOURCE),
        xml.command("TriggerSoftware", "TriggerSoftwareReg"),
        xml.register("TriggerSoftwareReg", at.TRIGGER_SOFTWARE),
    )
    return "".join(parts)


def _transport() -> str:
    return (
        xml.register("PayloadSize", at.PAYLOAD_SIZE, cached=False)
        + xml.node("Integer", "TLParamsLocked", ("Value", 0), ("Min", 0), ("Max", 1))
        + xml.node("Port", "Device")
    )


def _chunks() -> str:
    entries = tuple(Entry(chunk.name, index) for index, chunk in enumerate(CHUNKS))
    enable = (
        '<IntReg Name="ChunkEnableReg" NameSpace="Custom">'
        f"<Address>0x{at.CHUNK_ENABLE[0].address:08X}</Address>"
        '<pIndex Offset="4">ChunkSelectorValue</pIndex><Length>4</Length><AccessMode>RW</AccessMode>'
        "<pPort>Device</pPort><Sign>Unsigned</Sign><Endianess>LittleEndian</Endianess></IntReg>\n"
    )
    selector = xml.enumeration("ChunkSelector", "ChunkSelectorValue", *entries)
    selects = selector.replace("</Enumeration>", "<pSelected>ChunkEnable</pSelected></Enumeration>")
    return (
        xml.boolean("ChunkModeActive", "ChunkModeReg", locked=True)
        + xml.register("ChunkModeReg", at.CHUNK_MODE_ACTIVE)
        + selects
        + xml.node("Integer", "ChunkSelectorValue", ("Value", 1), ("Min", 0), ("Max", len(CHUNKS) - 1))
        + xml.boolean("ChunkEnable", "ChunkEnableReg", locked=True)
        + enable
        + "".join(chunk.nodes() for chunk in CHUNKS if chunk.feature)
    )
