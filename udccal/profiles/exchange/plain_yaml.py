"""The part of YAML that camera calibrations are written in: nested names, numbers, words and lists of them.

A reader of all of YAML would let a file build objects, and repeat itself without end. This one knows no tags (it skips
OpenCV's ``!!opencv-matrix``), no references, and no lists within lists.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NoReturn, final

import numpy as np
from jaxtyping import Float

from udccal.errors import ProfileError

_DEEPEST = 8
_NAME = re.compile(r"([A-Za-z_][A-Za-z0-9_.\- ]{0,99}):(?:\s+(.*))?$")
_TAG = re.compile(r"!![A-Za-z0-9-]{1,40}")
_NUMBER = re.compile(r"[-+]?(\d{1,400}(\.\d{0,400})?|\.\d{1,400})([eE][-+]?\d{1,4})?")
_WHOLE = re.compile(r"\d{1,9}")
_QUOTES = "\"'"


@final
@dataclass(frozen=True)
class _Line:
    indent: int
    text: str


@final
@dataclass(frozen=True)
class Document:
    """A mapping of names; each has a word, a list of words, or a mapping.

    Attributes:
        where: the file and the place in it, for messages.
    """

    where: str
    entries: Mapping[str, str | tuple[str, ...] | Document]

    def word(self, name: str) -> str:
        """Return the word at a name."""
        value = self._at(name)
        return value if isinstance(value, str) else self._refuse(name, "one word", value)

    def whole(self, name: str) -> int:
        """Return the whole number at a name."""
        text = self.word(name)
        return int(text) if _WHOLE.fullmatch(text) else self._refuse(name, "a whole number", text)

    def matrix(self, name: str) -> Float[np.ndarray, "rows columns"]:
        """Return the matrix at a name, whose entries are ``rows``, ``cols`` and ``data``."""
        entry = self._at(name)
        if not isinstance(entry, Document):
            self._refuse(name, "a matrix with rows, cols and data", entry)
        shape, data = (entry.whole("rows"), entry.whole("cols")), entry._at("data")
        if isinstance(data, Document) or math.prod(shape) != len(data) or isinstance(data, str):
            self._refuse(name, f"{shape[0]} x {shape[1]} numbers", data)
        return np.array([entry._real("data", text) for text in data]).reshape(shape)

    def matrix_of(self, name: str, rows: int, columns: int) -> Float[np.ndarray, "rows columns"]:
        """Return the matrix at a name, which must have this size."""
        found = self.matrix(name)
        if found.shape != (rows, columns):
            self._refuse(name, f"a matrix of {rows} x {columns}", f"{found.shape[0]} x {found.shape[1]}")
        return found

    def _real(self, name: str, text: str) -> float:
        value = float(text) if _NUMBER.fullmatch(text) else math.nan
        return value if math.isfinite(value) else self._refuse(name, "finite numbers", text)

    def _at(self, name: str) -> str | tuple[str, ...] | Document:
        if name not in self.entries:
            raise ProfileError(f"Expected '{name}' in {self.where}, found none. Check that it is the right format.")
        return self.entries[name]

    def _refuse(self, name: str, expected: str, found: object) -> NoReturn:
        shown = "a mapping" if isinstance(found, Document) else _short(found)
        raise ProfileError(f"Expected '{name}' in {self.where} to be {expected}, found {shown}. Correct the file.")


def read_yaml(text: str, where: str) -> Document:
    """Read a document.

    Args:
        text: of a bounded size.
        where: the file, for messages.

    Raises:
        ProfileError: when it has anything else than names, numbers, words and lists of them, with the line's text.
    """
    document, rest = _mapping(_lines(text, where), where, 1)
    if rest:
        _refuse_line(where, rest[0].text)
    return document


def _lines(text: str, where: str) -> list[_Line]:
    """The lines without comments; a list over several lines is made one."""
    lines: list[_Line] = []
    open_list: list[str] | None = None
    for raw in text.replace("\t", " ").splitlines():
        plain = _without_comment(raw)
        stripped = plain.strip()
        if open_list is not None:
            open_list.append(stripped)
            if "]" in stripped:
                lines[-1] = _Line(lines[-1].indent, " ".join(open_list))
                open_list = None
        elif stripped in ("", "---", "...") or (stripped.startswith("%YAML") and not lines):
            continue
        else:
            lines.append(_Line(len(plain) - len(plain.lstrip()), stripped))
            if "[" in stripped and "]" not in stripped and not _quoted(stripped):
                open_list = [stripped]
    if open_list is not None:
        _refuse_line(where, open_list[0])
    return lines


def _without_comment(line: str) -> str:
    if "#" not in line:
        return line
    quote = ""
    for at, letter in enumerate(line):
        if quote:
            quote = "" if letter == quote else quote
        elif letter in _QUOTES:
            quote = letter
        elif letter == "#" and (at == 0 or line[at - 1].isspace()):
            return line[:at]
    return line


def _mapping(lines: Sequence[_Line], where: str, depth: int) -> tuple[Document, Sequence[_Line]]:
    """The mapping that the lines begin with, and the lines after it."""
    entries: dict[str, str | tuple[str, ...] | Document] = {}
    at, indent = 0, lines[0].indent if lines else 0
    while at < len(lines) and lines[at].indent == indent:
        found = _NAME.fullmatch(lines[at].text)
        if found is None or found[1] in entries or depth > _DEEPEST:
            _refuse_line(where, lines[at].text)
        name, value = found[1], _TAG.sub("", found[2] or "", count=1).strip()
        at += 1
        if value:
            entries[name] = _value(value, where)
        elif at < len(lines) and lines[at].text.startswith("- ") and lines[at].indent >= indent:
            items, dashed = [], lines[at].indent
            while at < len(lines) and lines[at].indent == dashed and lines[at].text.startswith("- "):
                items.append(_word(lines[at].text[2:], where))
                at += 1
            entries[name] = tuple(items)
        elif at < len(lines) and lines[at].indent > indent:
            end = next((i for i in range(at, len(lines)) if lines[i].indent <= indent), len(lines))
            entries[name], rest = _mapping(lines[at:end], f"'{name}' of {where}", depth + 1)
            if rest:
                _refuse_line(where, rest[0].text)
            at = end
        else:
            entries[name] = ""
    return Document(where, entries), lines[at:]


def _value(text: str, where: str) -> str | tuple[str, ...]:
    if not text.startswith("["):
        return _word(text, where)
    if not text.endswith("]"):
        _refuse_line(where, text)
    inner = text[1:-1].strip().removesuffix(",")
    return tuple(_word(item, where) for item in inner.split(",")) if inner else ()


def _word(text: str, where: str) -> str:
    text = text.strip()
    if _quoted(text):
        return text[1:-1]
    if not text or text[0] in "[]{}&*|>!%@`\"'" or "[" in text or ": " in text:
        _refuse_line(where, text)
    return text


def _quoted(text: str) -> bool:
    return len(text) >= 2 and text[0] in _QUOTES and text[-1] == text[0] and text[0] not in text[1:-1]


def _refuse_line(where: str, text: str) -> NoReturn:
    raise ProfileError(
        f"Expected names with numbers, words and lists of them in {where}, found '{_short(text)}'. Write it as plain "
        "YAML."
    )


def _short(found: object) -> str:
    return str(found)[:60]
