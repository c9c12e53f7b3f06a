"""Checks the outline of a description before GenApi gets it, since GenApi trusts its input."""

from __future__ import annotations

import re
from typing import Final, final
from xml.parsers import expat

from udccal.errors import CameraProtocolError

_ROOT: Final = "RegisterDescription"
_MOST_DEPTH: Final = 32
_MOST_ELEMENTS: Final = 300_000
# Elements that refer to a node have these endings; GenApi follows them without a check of the node's kind.
_REFERENCE: Final = re.compile("p[A-Z]")
_PORT_REFERENCE: Final = "pPort"
_PORT: Final = "Port"
_PLACES_OF_NODES: Final = ([_ROOT], ["Group"])
_PART_OF_REGISTER: Final = "StructEntry"  # becomes a node by itself


def check_outline(text: str) -> None:
    """Refuse a description with another root, with a document type (and so entities), too deep, or too long.

    Refuse also references to a kind of node that is not allowed there, which GenApi would not notice.

    Raises:
        CameraProtocolError: when the description is refused.
        expat.ExpatError: when the text is not well-formed.
    """
    outline = _Outline()
    parser = expat.ParserCreate("utf-8")
    parser.buffer_text = True
    parser.StartElementHandler = outline.start
    parser.EndElementHandler = outline.end
    parser.CharacterDataHandler = outline.characters
    parser.StartDoctypeDeclHandler = outline.doctype
    parser.Parse(text.encode(), True)
    outline.check_references()


def unsound(expected: str, found: str) -> CameraProtocolError:
    """Return the error of an invalid description."""
    return CameraProtocolError(
        f"Expected {expected} in the camera, found {found}. Unplug it and plug it in again; "
        "if that does not help, update its firmware."
    )


@final
class _Outline:
    """Records elements, kinds of nodes and references between them while expat parses a text."""

    def __init__(self) -> None:
        self._path: list[str] = []
        self._text = ""
        self._elements = 0
        self._kinds: dict[str, str] = {}
        self._references: list[tuple[str, str]] = []

    def start(self, name: str, attributes: dict[str, str]) -> None:
        tag = _local(name)
        if not self._elements and tag != _ROOT:
            raise unsound(f"a description whose root is {_ROOT}", f"{tag[:40]!r}")
        self._path.append(tag)
        self._text = ""
        self._elements += 1
        if len(self._path) > _MOST_DEPTH or self._elements > _MOST_ELEMENTS:
            raise unsound(
                f"a description of up to {_MOST_ELEMENTS} elements, {_MOST_DEPTH} deep",
                f"{self._elements} elements, {len(self._path)} deep",
            )
        # Names of entries, variables and constants are local to their node.
        is_node = self._path[-2:-1] in _PLACES_OF_NODES or tag == _PART_OF_REGISTER
        if tag == _PORT and not is_node:
            raise unsound("a description with ports among its nodes", f"one inside {self._path[-2]}")
        if is_node and "Name" in attributes:
            self._kinds[attributes["Name"]] = tag

    def characters(self, text: str) -> None:
        self._text += text

    def end(self, name: str) -> None:
        tag = self._path.pop()
        if _REFERENCE.match(tag):
            self._references.append((tag, self._text.strip()))
        self._text = ""

    def doctype(self, name: str, system: str | None, public: str | None, internal: int) -> None:
        raise unsound("a description without a document type", f"{name[:40]!r}")

    def check_references(self) -> None:
        for reference, target in self._references:
            kind = self._kinds.get(target, "nothing")
            if (kind == _PORT) != (reference == _PORT_REFERENCE):
                raise unsound(f"another kind of node at the end of {reference}", f"{kind} {target[:40]!r}")


def _local(name: str) -> str:
    return name.rpartition(":")[2]
