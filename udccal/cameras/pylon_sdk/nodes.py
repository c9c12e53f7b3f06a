"""Reads and sets a GenICam node map by feature name; a feature may be absent or have an older name."""

from __future__ import annotations

from typing import Any, final

from udccal.cameras.protocol import Range


@final
class Nodes:
    """The features of one node map. Methods take several names and use the first that the device has."""

    def __init__(self, node_map: Any) -> None:
        """Wrap a node map of an open device, or of one frame's chunk data."""
        self._map = node_map

    def has(self, *names: str) -> bool:
        """Return whether one of them can be read now."""
        return self._readable(names) is not None

    def number(self, *names: str) -> float | None:
        """Return a number; None when absent."""
        node = self._readable(names, "GetMin")
        return None if node is None else float(node.GetValue())

    def text(self, *names: str) -> str:
        """Return a text or a choice; empty when absent."""
        node = self._readable(names)
        return "" if node is None else str(node.GetValue())

    def flag(self, *names: str) -> bool | None:
        """Return a switch; None when absent."""
        node = self._readable(names)
        return None if node is None else bool(node.GetValue())

    def bounds(self, *names: str) -> Range | None:
        """Return the current bounds of a number; None when absent."""
        node = self._readable(names, "GetMin")
        return None if node is None else Range(float(node.GetMin()), float(node.GetMax()))

    def step(self, name: str) -> int:
        """Return the step of a whole number; 1 when absent."""
        node = self._readable((name,), "GetInc")
        return 1 if node is None else max(1, int(node.GetInc()))

    def choices(self, name: str) -> tuple[str, ...]:
        """Return the values that a choice can be set to now; empty when absent."""
        node = self._readable((name,), "GetSettableValues")
        return () if node is None else tuple(node.GetSettableValues())

    def set_number(self, value: float, *names: str) -> bool:
        """Set a number of any kind; return False when none of the names can be written."""
        return self._set(value, names)

    def set_whole(self, value: int, *names: str) -> bool:
        """Set a whole number; return False when none of the names can be written."""
        return self._set(value, names)

    def set_flag(self, value: bool, *names: str) -> bool:
        """Set a switch; return False when none of the names can be written."""
        return self._set(value, names)

    def choose(self, name: str, value: str) -> bool:
        """Set a choice; return False when it is absent, cannot be written, or does not have the value."""
        return value in self.choices(name) and self._set(value, (name,))

    def _set(self, value: int | float | str, names: tuple[str, ...]) -> bool:
        node = next((node for name in names if (node := self._map.GetNode(name)).IsWritable()), None)
        if node is not None:
            node.SetValue(value)
        return node is not None

    def _readable(self, names: tuple[str, ...], able_to: str = "GetValue") -> Any:
        """Return the first readable node whose kind has a method."""
        nodes = (self._map.GetNode(name) for name in names)
        return next((node for node in nodes if node.IsReadable() and hasattr(node, able_to)), None)
