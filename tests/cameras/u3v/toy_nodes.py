"""A camera of 2013 on paper: a description with names from before SFNC 2.0, on registers that obey."""

from __future__ import annotations

import struct

HEAD = (
    '<RegisterDescription ModelName="Toy" VendorName="udccal" ToolTip="" StandardNameSpace="None" '
    'SchemaMajorVersion="1" SchemaMinorVersion="1" SchemaSubMinorVersion="0" MajorVersion="1" MinorVersion="0" '
    'SubMinorVersion="0" ProductGuid="5E1DD0C1-98A4-4E5A-9E4B-0C9B2E6C4A11" '
    'VersionGuid="A3C4BC1E-7B4E-4F37-8B2A-3C0E5C1F7D52" xmlns="http://www.genicam.org/GenApi/Version_1_1">'
)
TAIL = '<Port Name="Device"/></RegisterDescription>'


def integer_register(name: str, address: int | str, extra: str = "") -> str:
    place = f"<Address>{address}</Address>" if isinstance(address, int) else address
    return (
        f'<IntReg Name="{name}">{place}<Length>4</Length><AccessMode>RW</AccessMode>'
        f"<pPort>Device</pPort>{extra}<Sign>Unsigned</Sign><Endianess>LittleEndian</Endianess></IntReg>"
    )


def float_register(name: str, address: int, port: str = "Device") -> str:
    return (
        f'<FloatReg Name="{name}"><Address>{address}</Address><Length>8</Length><AccessMode>RW</AccessMode>'
        f"<pPort>{port}</pPort><Endianess>LittleEndian</Endianess></FloatReg>"
    )


def enumeration(name: str, address: int | str, **entries: int) -> str:
    listed = "".join(f'<EnumEntry Name="{e}"><Value>{v}</Value></EnumEntry>' for e, v in entries.items())
    register = integer_register(f"{name}Reg", address)
    return f'<Enumeration Name="{name}">{listed}<pValue>{name}Reg</pValue></Enumeration>{register}'


def boolean(name: str, address: int) -> str:
    return (
        f'<Boolean Name="{name}"><pValue>{name}Reg</pValue><OnValue>1</OnValue><OffValue>0</OffValue></Boolean>'
        + integer_register(f"{name}Reg", address)
    )


def number(name: str, address: int, low: float, high: float) -> str:
    return f'<Float Name="{name}"><pValue>{name}Reg</pValue><Min>{low}</Min><Max>{high}</Max></Float>' + float_register(
        f"{name}Reg", address
    )


def size(name: str, address: int, low: int, high: int, step: int) -> str:
    return (
        f'<Integer Name="{name}"><pValue>{name}Reg</pValue><Min>{low}</Min><Max>{high}</Max><Inc>{step}</Inc></Integer>'
        + integer_register(f"{name}Reg", address)
    )


class Registers:
    """A memory that remembers what is written, and in which order."""

    def __init__(self) -> None:
        self.content = bytearray(256)
        self.written: list[int] = []

    def read(self, address: int, length: int) -> bytes:
        return bytes(self.content[address : address + length])

    def write(self, address: int, data: bytes) -> None:
        self.written.append(address)
        self.content[address : address + len(data)] = data

    def uint(self, address: int) -> int:
        return int(struct.unpack_from("<I", self.content, address)[0])

    def set_uint(self, address: int, value: int) -> None:
        struct.pack_into("<I", self.content, address, value)
