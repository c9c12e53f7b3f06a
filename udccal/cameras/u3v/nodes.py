"""Reads and sets a camera's features by name through EMVA's GenApi; its description maps them to registers."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final, Protocol, final, runtime_checkable

from udccal.cameras.protocol import Range
from udccal.cameras.u3v.polling import comes_true
from udccal.errors import CameraError, CameraProtocolError, CameraTimeout

_PORT: Final = "Device"
_MOST_INTEGER: Final = 1 << 63
_COMMAND_S: Final = 1.0
_COMMAND_POLL_S: Final = 5e-3


@runtime_checkable
class Registers(Protocol):
    """A device's memory."""

    def read(self, address: int, length: int) -> bytes:
        """Read ``length`` bytes from an address."""
        ...

    def write(self, address: int, data: bytes) -> None:
        """Write ``data`` to an address."""
        ...


@final
class NodeMap:
    """The features that a description defines, on a device's memory.

    Every method that asks for a feature raises CameraError when the camera does not have it or refuses, and the errors
    of the memory.

    Args:
        xml: a checked description; GenApi itself would follow its entities.

    Raises:
        CameraProtocolError: when the description has no port to the device.
        CameraError: when GenApi is not installed, or cannot interpret the description.
    """

    def __init__(self, xml: str, memory: Registers) -> None:
        self._genapi = _import_genapi()
        self._map = self._genapi.NodeMap()
        with self._told("load its description"):
            self._map.load_xml_from_string(xml)
            # GenApi takes any node of this name for a port, and would crash the process.
            if not isinstance(self._map.get_node(_PORT), self._genapi.IPort):
                raise CameraProtocolError(
                    f"Expected a description with a port {_PORT}, found none. Update the camera's firmware."
                )
            self._port = _port(self._genapi, memory)
            self._map.connect(self._port, _PORT)
            self._chunks = self._genapi.ChunkAdapterU3V(self._map)

    def refresh(self) -> None:
        """Invalidate every value that was read: GenApi caches them, and cameras change some by themselves."""
        # To invalidate one node would keep the registers below it.
        self._map._invalidate_nodes()

    def has(self, name: str) -> bool:
        """Return whether the camera has the feature in its current state."""
        return self._access(name) >= self._genapi.EAccessMode.WO

    def writable(self, name: str, kind: str | None = None) -> bool:
        """Return whether the feature may be set now.

        Args:
            kind: GenApi's interface that the feature must also have, e.g. ``IFloat``.
        """
        if self._access(name) not in (self._genapi.EAccessMode.WO, self._genapi.EAccessMode.RW):
            return False
        return kind is None or isinstance(self._map.get_node(name), getattr(self._genapi, kind))

    def first(self, *names: str) -> str | None:
        """Return the first of several names that the camera has."""
        return next((name for name in names if self.has(name)), None)

    def number(self, name: str) -> float:
        """Return a number, whether GenApi holds it as integer or as float."""
        with self._told(f"read {name}"):
            value = float(self._number(name).value)
        if not math.isfinite(value):
            raise CameraProtocolError(f"Expected a number in {name}, found {value}. Update the camera's firmware.")
        return value

    def bounds(self, name: str) -> Range:
        """Return the bounds between which a number may be set now."""
        with self._told(f"read the limits of {name}"):
            node = self._number(name)
            bounds = Range(float(node.min), float(node.max))
        if not bounds.low <= bounds.high < math.inf:
            raise CameraProtocolError(
                f"Expected limits of {name}, found {bounds.low} to {bounds.high}. Update the camera's firmware."
            )
        return bounds

    def step(self, name: str) -> int:
        """Return the step of an integer; 1 when the camera does not give it."""
        with self._told(f"read the step of {name}"):
            return max(1, int(self._number(name).inc))

    def set_number(self, name: str, value: float | int) -> None:
        """Set a number; one that the camera has fixed at this value is not written."""
        with self._told(f"set {name} to {value:g}"):
            if not abs(value) < _MOST_INTEGER:
                raise ValueError("no number that a register holds")
            node = self._number(name)
            if not (self._fixed(node) and float(node.value) == value):
                node.value = round(value) if isinstance(node, self._genapi.IInteger) else float(value)

    def choice(self, name: str) -> str:
        """Return the value of an enumeration."""
        with self._told(f"read {name}"):
            return str(self._node(name, "IEnumeration").value)

    def choices(self, name: str) -> tuple[str, ...]:
        """Return the values that an enumeration may be set to now."""
        with self._told(f"read the choices of {name}"):
            return tuple(str(symbol) for symbol in self._node(name, "IEnumeration").symbolics)

    def choose(self, name: str, symbol: str) -> None:
        """Set an enumeration; one that the camera has fixed at this value is not written."""
        with self._told(f"set {name} to {symbol}"):
            node = self._node(name, "IEnumeration")
            if not (self._fixed(node) and str(node.value) == symbol):
                node.value = symbol

    def flag(self, name: str) -> bool:
        """Return a boolean."""
        with self._told(f"read {name}"):
            return bool(self._node(name, "IBoolean").value)

    def set_flag(self, name: str, value: bool) -> None:
        """Set a boolean; one that the camera has fixed at this value is not written."""
        with self._told(f"set {name} to {value}"):
            node = self._node(name, "IBoolean")
            if not (self._fixed(node) and bool(node.value) == value):
                node.value = value

    def execute(self, name: str, wait_s: float = _COMMAND_S) -> None:
        """Execute a command, and wait until the camera has finished.

        Raises:
            CameraTimeout: when it has not finished in that time.
        """
        with self._told(f"execute {name}"):
            node = self._node(name, "ICommand")
            node.execute()
            if comes_true(node.is_done, wait_s, _COMMAND_POLL_S):
                return
        raise CameraTimeout(f"Expected {name} to finish, found it still running. Open the camera again.")

    @contextmanager
    def chunks(self, data: bytes) -> Iterator[None]:
        """Make features in chunk data readable inside the context; ``data`` must be a valid sequence of chunks."""
        with self._told("lay out its chunk data"):
            self._chunks.attach_buffer(data, len(data))
        try:
            yield
        finally:
            self._chunks.detach_buffer()

    def close(self) -> None:
        """Release the memory and the node map."""
        # A finalizer keeps the adapter until the program ends, and the node map with it.
        self._chunks.detach_node_map()
        self._map.disconnect()

    def _access(self, name: str) -> int:
        with self._told(f"say whether it has {name}"):
            try:
                node = self._map.get_node(name)
            except self._genapi.LogicalErrorException:
                return int(self._genapi.EAccessMode.NI)
            return int(self._genapi.EAccessMode.NI) if node is None else int(node.get_access_mode())

    def _fixed(self, node: Any) -> bool:
        return bool(node.get_access_mode() == self._genapi.EAccessMode.RO)

    def _number(self, name: str) -> Any:
        return self._node(name, "IFloat", "IInteger")

    def _node(self, name: str, *kinds: str) -> Any:
        """Return a feature if GenApi holds it as one of these kinds; a description may define any kind."""
        node = self._map.get_node(name)
        found = "nothing of that name" if node is None else f"an {type(node).__name__}"
        if not any(isinstance(node, getattr(self._genapi, kind)) for kind in kinds):
            raise CameraError(
                f"Expected the camera's {name} to be an {' or '.join(kinds)}, found {found}. Use another camera."
            )
        return node

    @contextmanager
    def _told(self, what: str) -> Iterator[None]:
        """Turn GenApi's exceptions into sentences; pass those of the memory on unchanged."""
        try:
            yield
        except (self._genapi.GenericException, RuntimeError, TypeError, ValueError, ArithmeticError) as error:
            # GenApi names its own source files after the first colon.
            reason = " ".join(str(error).split(" : ")[0].split()).rstrip(".")[:200] or type(error).__name__
            raise CameraError(
                f"Expected the camera to {what}, found: {reason}. Ask for something that it can do."
            ) from error


def _import_genapi() -> Any:
    try:
        from genicam import genapi
    except ImportError as error:
        raise CameraError("Expected EMVA's GenApi, found none. Install it with: pip install genicam") from error
    return genapi


def _port(genapi: Any, memory: Registers) -> Any:
    """Return GenApi's port to a device's memory; its base class exists only once GenApi is imported."""

    @final
    class DevicePort(genapi.AbstractPort):
        def __init__(self) -> None:
            super().__init__()

        def get_access_mode(self) -> int:
            return int(genapi.EAccessMode.RW)

        def read(self, address: int, length: int) -> bytes:
            return memory.read(address, length)

        def write(self, address: int, data: bytes) -> None:
            memory.write(address, bytes(data))

    return DevicePort()
