"""Fills the bootstrap registers, as they stand when the camera gets power."""

from __future__ import annotations

from tests.virtual_u3v import registers as at
from tests.virtual_u3v.memory import Memory
from tests.virtual_u3v.model import CameraModel, Speed
from tests.virtual_u3v.stream_protocol import LEADER_SIZE, TRAILER_SIZE

_VERSION_1_1, _VERSION_1_0 = 0x0001_0001, 0x0001_0000
# User defined name, time stamp, family name, SBRM, endianness registers, written-length field (GenCP 1.x §5.1.9).
_CAPABILITY = 1 << 0 | 1 << 3 | 1 << 8 | 1 << 9 | 1 << 10 | 1 << 11
_LITTLE_ENDIAN = 0xFFFF_FFFF


def fill(memory: Memory, model: CameraModel, speed: Speed) -> None:
    """Write ABRM, SBRM, SIRM and EIRM."""
    _technology_agnostic(memory, model)
    put = memory.put_uint
    put(at.U3V_VERSION, _VERSION_1_0)
    put(at.U3VCP_CAPABILITY, 0b11 if model.event_interface else 0b01)
    put(at.MAXIMUM_COMMAND_TRANSFER_LENGTH, model.max_transfer)
    put(at.MAXIMUM_ACKNOWLEDGE_TRANSFER_LENGTH, model.max_transfer)
    put(at.NUMBER_OF_STREAM_CHANNELS, 1)
    put(at.SIRM_ADDRESS, at.SIRM)
    put(at.SIRM_LENGTH, 0x30)
    put(at.CURRENT_SPEED, speed.u3v_bit)
    put(at.SI_INFO, (model.alignment.bit_length() - 1) << 24)
    put(at.SI_REQUIRED_LEADER_SIZE, LEADER_SIZE)
    put(at.SI_REQUIRED_TRAILER_SIZE, TRAILER_SIZE)
    if model.event_interface:
        put(at.EIRM_ADDRESS, at.EIRM)
        put(at.EIRM_LENGTH, 0xC)
        put(at.EI_MAXIMUM_EVENT_TRANSFER_LENGTH, model.max_transfer)


def _technology_agnostic(memory: Memory, model: CameraModel) -> None:
    strings = (
        (at.MANUFACTURER_NAME, model.vendor),
        (at.MODEL_NAME, model.model),
        (at.FAMILY_NAME, model.family),
        (at.DEVICE_VERSION, model.version),
        (at.MANUFACTURER_INFO, "simulated"),
        (at.SERIAL_NUMBER, model.serial),
    )
    for register, text in strings:
        memory.put(register, text.encode())
    put = memory.put_uint
    put(at.GENCP_VERSION, _VERSION_1_1)
    put(at.DEVICE_CAPABILITY, _CAPABILITY)
    put(at.MAXIMUM_DEVICE_RESPONSE_TIME, model.response_ms)
    put(at.MANIFEST_TABLE_ADDRESS, at.MANIFEST)
    put(at.SBRM_ADDRESS, at.SBRM)
    put(at.TIMESTAMP_INCREMENT, 1)
    put(at.PROTOCOL_ENDIANNESS, _LITTLE_ENDIAN)
    put(at.IMPLEMENTATION_ENDIANNESS, _LITTLE_ENDIAN)
