"""Addresses of the virtual camera's registers.

ABRM after GenCP 1.x §5 (technology agnostic bootstrap register map); SBRM, SIRM and EIRM after USB3 Vision 1.0 §4 and
§5; from FEATURES on the camera's own registers, which only its GenICam description explains.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass


class Access(enum.Enum):
    """Who may do what with a register."""

    RO = "RO"
    RW = "RW"
    WO = "WO"


@dataclass(frozen=True)
class Register:
    """A register: where it is, how many bytes it has, and who may write it."""

    address: int
    length: int
    access: Access = Access.RO


ABRM = 0x0000_0000
SBRM = 0x0001_0000
SIRM = 0x0002_0000
EIRM = 0x0003_0000
MANIFEST = 0x0004_0000
FEATURES = 0x0010_0000
DESCRIPTION = 0x0100_0000

GENCP_VERSION = Register(ABRM + 0x000, 4)
MANUFACTURER_NAME = Register(ABRM + 0x004, 64)
MODEL_NAME = Register(ABRM + 0x044, 64)
FAMILY_NAME = Register(ABRM + 0x084, 64)
DEVICE_VERSION = Register(ABRM + 0x0C4, 64)
MANUFACTURER_INFO = Register(ABRM + 0x104, 64)
SERIAL_NUMBER = Register(ABRM + 0x144, 64)
USER_DEFINED_NAME = Register(ABRM + 0x184, 64, Access.RW)
DEVICE_CAPABILITY = Register(ABRM + 0x1C4, 8)
MAXIMUM_DEVICE_RESPONSE_TIME = Register(ABRM + 0x1CC, 4)
MANIFEST_TABLE_ADDRESS = Register(ABRM + 0x1D0, 8)
SBRM_ADDRESS = Register(ABRM + 0x1D8, 8)
DEVICE_CONFIGURATION = Register(ABRM + 0x1E0, 8, Access.RW)
HEARTBEAT_TIMEOUT = Register(ABRM + 0x1E8, 4)
MESSAGE_CHANNEL_ID = Register(ABRM + 0x1EC, 4)
TIMESTAMP = Register(ABRM + 0x1F0, 8)
TIMESTAMP_LATCH = Register(ABRM + 0x1F8, 4, Access.WO)
TIMESTAMP_INCREMENT = Register(ABRM + 0x1FC, 8)
ACCESS_PRIVILEGE = Register(ABRM + 0x204, 4)
PROTOCOL_ENDIANNESS = Register(ABRM + 0x208, 4)
IMPLEMENTATION_ENDIANNESS = Register(ABRM + 0x20C, 4)

U3V_VERSION = Register(SBRM + 0x00, 4)
U3VCP_CAPABILITY = Register(SBRM + 0x04, 8)
U3VCP_CONFIGURATION = Register(SBRM + 0x0C, 8, Access.RW)
MAXIMUM_COMMAND_TRANSFER_LENGTH = Register(SBRM + 0x14, 4)
MAXIMUM_ACKNOWLEDGE_TRANSFER_LENGTH = Register(SBRM + 0x18, 4)
NUMBER_OF_STREAM_CHANNELS = Register(SBRM + 0x1C, 4)
SIRM_ADDRESS = Register(SBRM + 0x20, 8)
SIRM_LENGTH = Register(SBRM + 0x28, 4)
EIRM_ADDRESS = Register(SBRM + 0x2C, 8)
EIRM_LENGTH = Register(SBRM + 0x34, 4)
IIDC2_ADDRESS = Register(SBRM + 0x38, 8)
CURRENT_SPEED = Register(SBRM + 0x40, 4)

SI_INFO = Register(SIRM + 0x00, 4)
SI_CONTROL = Register(SIRM + 0x04, 4, Access.RW)
SI_REQUIRED_PAYLOAD_SIZE = Register(SIRM + 0x08, 8)
SI_REQUIRED_LEADER_SIZE = Register(SIRM + 0x10, 4)
SI_REQUIRED_TRAILER_SIZE = Register(SIRM + 0x14, 4)
SI_MAXIMUM_LEADER_SIZE = Register(SIRM + 0x18, 4, Access.RW)
SI_PAYLOAD_TRANSFER_SIZE = Register(SIRM + 0x1C, 4, Access.RW)
SI_PAYLOAD_TRANSFER_COUNT = Register(SIRM + 0x20, 4, Access.RW)
SI_PAYLOAD_FINAL_TRANSFER1_SIZE = Register(SIRM + 0x24, 4, Access.RW)
SI_PAYLOAD_FINAL_TRANSFER2_SIZE = Register(SIRM + 0x28, 4, Access.RW)
SI_MAXIMUM_TRAILER_SIZE = Register(SIRM + 0x2C, 4, Access.RW)

EI_CONTROL = Register(EIRM + 0x0, 4, Access.RW)
EI_MAXIMUM_EVENT_TRANSFER_LENGTH = Register(EIRM + 0x4, 4)
EI_EVENT_TEST_CONTROL = Register(EIRM + 0x8, 4, Access.WO)

SENSOR_WIDTH = Register(FEATURES + 0x00, 4)
SENSOR_HEIGHT = Register(FEATURES + 0x04, 4)
WIDTH = Register(FEATURES + 0x08, 4, Access.RW)
HEIGHT = Register(FEATURES + 0x0C, 4, Access.RW)
OFFSET_X = Register(FEATURES + 0x10, 4, Access.RW)
OFFSET_Y = Register(FEATURES + 0x14, 4, Access.RW)
PIXEL_FORMAT = Register(FEATURES + 0x18, 4, Access.RW)
PAYLOAD_SIZE = Register(FEATURES + 0x1C, 4)
EXPOSURE_AUTO = Register(FEATURES + 0x20, 4, Access.RW)
EXPOSURE_TIME_RAW = Register(FEATURES + 0x24, 4, Access.RW)  # in 0.1 us
GAIN_AUTO = Register(FEATURES + 0x28, 4, Access.RW)
GAIN_RAW = Register(FEATURES + 0x2C, 4, Access.RW)  # in 0.1 dB
ACQUISITION_MODE = Register(FEATURES + 0x30, 4, Access.RW)
ACQUISITION_FRAME_COUNT = Register(FEATURES + 0x34, 4, Access.RW)
ACQUISITION_START = Register(FEATURES + 0x38, 4, Access.WO)
ACQUISITION_STOP = Register(FEATURES + 0x3C, 4, Access.WO)
ACQUISITION_FRAME_RATE_ENABLE = Register(FEATURES + 0x40, 4, Access.RW)
ACQUISITION_FRAME_RATE = Register(FEATURES + 0x44, 8, Access.RW)  # IEEE 754 double, Hz
TRIGGER_MODE = Register(FEATURES + 0x4C, 4, Access.RW)
TRIGGER_SOURCE = Register(FEATURES + 0x50, 4, Access.RW)
TRIGGER_SOFTWARE = Register(FEATURES + 0x54, 4, Access.WO)
CHUNK_MODE_ACTIVE = Register(FEATURES + 0x58, 4, Access.RW)
TEMPERATURE_RAW = Register(FEATURES + 0x5C, 4)  # signed, in 1/16 degree Celsius
CHUNK_ENABLE = tuple(Register(FEATURES + 0x60 + 4 * index, 4, Access.RW) for index in range(5))  # by ChunkSelector

EVERY_REGISTER = tuple(
    register
    for value in tuple(globals().values())
    for register in (value if isinstance(value, tuple) else (value,))
    if isinstance(register, Register)
)
