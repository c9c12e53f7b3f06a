"""Stand-ins for what the emulated camera cannot show: older features, chunks, devices that are held or gone."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import final

import numpy as np
from jaxtyping import UInt16

MONO12 = 0x01100005


class GenericException(Exception):
    """The root of the SDK's exceptions."""


@final
class TimeoutException(GenericException):
    pass


@final
@dataclass
class Number:
    """A node that holds a number; ``step`` of whole ones."""

    value: float
    low: float = 0.0
    high: float = 1e9
    step: int = 1

    def IsReadable(self) -> bool:
        return True

    def IsWritable(self) -> bool:
        return True

    def GetValue(self) -> float:
        return self.value

    def SetValue(self, value: float) -> None:
        if not self.low <= value <= self.high:
            raise GenericException(f"{value} is out of range : OutOfRangeException thrown")
        self.value = value

    def GetMin(self) -> float:
        return self.low

    def GetMax(self) -> float:
        return self.high

    def GetInc(self) -> int:
        return self.step


@final
@dataclass
class Choice:
    """A node that holds one of several names, or a switch without names."""

    value: str | bool
    names: tuple[str, ...] = ()

    def IsReadable(self) -> bool:
        return True

    def IsWritable(self) -> bool:
        return True

    def GetValue(self) -> str | bool:
        return self.value

    def SetValue(self, value: str | bool) -> None:
        self.value = value

    def GetSettableValues(self) -> tuple[str, ...]:
        return self.names


@final
class Absent:
    """What the SDK gives for a feature that the device does not have."""

    def IsReadable(self) -> bool:
        return False

    def IsWritable(self) -> bool:
        return False


@final
class NodeMap:
    """Nodes by name."""

    def __init__(self, **nodes: Number | Choice) -> None:
        self.nodes = nodes

    def GetNode(self, name: str) -> Number | Choice | Absent:
        return self.nodes.get(name, Absent())


@final
@dataclass
class Result:
    """A grab result of a Mono12 camera."""

    data: UInt16[np.ndarray, "rows columns"]
    chunks: NodeMap | None = None
    ticks: int = 0
    block_id: int = 0
    released: bool = False

    def IsValid(self) -> bool:
        return True

    def GrabSucceeded(self) -> bool:
        return True

    def IsChunkDataAvailable(self) -> bool:
        return self.chunks is not None

    def GetChunkDataNodeMap(self) -> NodeMap | None:
        return self.chunks

    def GetBlockID(self) -> int:
        return self.block_id

    def GetImageNumber(self) -> int:
        return 1

    def GetTimeStamp(self) -> int:
        return self.ticks

    def GetPixelType(self) -> int:
        return MONO12

    def GetHeight(self) -> int:
        return self.data.shape[0]

    def GetWidth(self) -> int:
        return self.data.shape[1]

    def GetPaddingX(self) -> int:
        return 0

    def GetImageMemoryView(self) -> memoryview:
        return memoryview(self.data.astype("<u2").tobytes())

    def Release(self) -> None:
        self.released = True


@final
@dataclass
class NoResult:
    """What the SDK gives when it is not grabbing."""

    def IsValid(self) -> bool:
        return False


@final
@dataclass
class InstantCamera:
    """A device that answers with what it was given; an exception is raised."""

    result: Result | NoResult | Exception = field(default_factory=NoResult)
    removed_after: int | None = None  # questions until the SDK notices; None for a device that stays

    def RetrieveResult(self, timeout_ms: int, handling: object) -> Result | NoResult:
        if isinstance(self.result, Exception):
            raise self.result
        return self.result

    def IsCameraDeviceRemoved(self) -> bool:
        if self.removed_after is None:
            return False
        self.removed_after -= 1
        return self.removed_after < 0

    def Open(self) -> None:
        if isinstance(self.result, Exception):
            raise self.result

    def GetNodeMap(self) -> NodeMap:
        return NodeMap()


@final
@dataclass(frozen=True)
class DeviceInfo:
    """A device that was found."""

    serial: str = "0042"

    def GetVendorName(self) -> str:
        return "Basler"

    def GetModelName(self) -> str:
        return "acA"

    def GetSerialNumber(self) -> str:
        return self.serial


@final
@dataclass
class Factory:
    """Finds devices that can be opened or not; stands for the module, too."""

    camera: InstantCamera
    accessible: tuple[bool, int] = (True, 1)
    Accessibility_Opened: int = 2
    Accessibility_OpenedExclusively: int = 3
    TimeoutHandling_ThrowException: int = 1

    @property
    def TlFactory(self) -> Factory:
        return self

    def GetInstance(self) -> Factory:
        return self

    def IsDeviceAccessibleInfo(self, info: DeviceInfo) -> tuple[bool, int]:
        return self.accessible

    def CreateDevice(self, info: DeviceInfo) -> object:
        return info

    def InstantCamera(self, device: object) -> InstantCamera:
        return self.camera


@final
class Genicam:
    """The other module."""

    GenericException = GenericException
    TimeoutException = TimeoutException
