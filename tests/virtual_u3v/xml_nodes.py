"""Writers of the GenApi nodes (GenICam GenApi schema 1.1) that the virtual camera's description is made of."""

from __future__ import annotations

from dataclasses import dataclass
from xml.sax.saxutils import escape

from tests.virtual_u3v.registers import Register

LOCKED = ("pIsLocked", "TLParamsLocked")


@dataclass(frozen=True)
class Entry:
    """An entry of an enumeration."""

    name: str
    value: int


def node(kind: str, name: str, *children: tuple[str, object]) -> str:
    """A node of ``kind`` with simple children in the order given, which the schema prescribes."""
    inside = "".join(f"<{tag}>{escape(str(text))}</{tag}>" for tag, text in children)
    return f'<{kind} Name="{name}" NameSpace="Standard">{inside}</{kind}>\n'


def category(name: str, *features: str) -> str:
    """A category and what it lists."""
    return node("Category", name, *(("pFeature", feature) for feature in features))


def register(name: str, where: Register, *, cached: bool = True, signed: bool = False) -> str:
    """An integer register."""
    return node(
        "IntReg",
        name,
        *_place(where, cached),
        ("Sign", "Signed" if signed else "Unsigned"),
        ("Endianess", "LittleEndian"),
    )


def double_register(name: str, where: Register) -> str:
    """A register with an IEEE 754 double."""
    return node("FloatReg", name, *_place(where, cached=True), ("Endianess", "LittleEndian"))


def string_register(name: str, where: Register) -> str:
    """A register with a zero-terminated string."""
    return node("StringReg", name, *_place(where, cached=True))


def integer(name: str, value: str, *limits: tuple[str, object], locked: bool = False) -> str:
    """An integer feature on the node ``value``."""
    return node("Integer", name, *((LOCKED,) if locked else ()), ("pValue", value), *limits)


def enumeration(name: str, value: str, *entries: Entry, locked: bool = False) -> str:
    """An enumeration on the node ``value``."""
    inside = "".join(
        f'<EnumEntry Name="{entry.name}" NameSpace="Standard"><Value>{entry.value}</Value></EnumEntry>'
        for entry in entries
    )
    lock = "<pIsLocked>TLParamsLocked</pIsLocked>" if locked else ""
    return f'<Enumeration Name="{name}" NameSpace="Standard">{lock}{inside}<pValue>{value}</pValue></Enumeration>\n'


def boolean(name: str, value: str, *, locked: bool = False) -> str:
    """A boolean on the node ``value``."""
    head = (LOCKED,) if locked else ()
    return node("Boolean", name, *head, ("pValue", value), ("OnValue", 1), ("OffValue", 0))


def command(name: str, value: str) -> str:
    """A command that writes 1 to the node ``value``."""
    return node("Command", name, ("pValue", value), ("CommandValue", 1))


def formula(kind: str, name: str, text: str, *variables: str, unit: str = "") -> str:
    """A SwissKnife or IntSwissKnife: a read-only value computed from other nodes, each a variable of its own name."""
    inside = "".join(f'<pVariable Name="{variable}">{variable}</pVariable>' for variable in variables)
    tail = f"<Unit>{unit}</Unit>" if unit else ""
    return f'<{kind} Name="{name}" NameSpace="Standard">{inside}<Formula>{escape(text)}</Formula>{tail}</{kind}>\n'


def converter(name: str, value: str, per_raw: float, unit: str, lock: str) -> str:
    """A float feature on the integer node ``value`` in steps of ``per_raw``, locked while ``lock`` is not 0."""
    return node(
        "Converter",
        name,
        ("pIsLocked", lock),
        ("FormulaTo", f"FROM / {per_raw}"),
        ("FormulaFrom", f"TO * {per_raw}"),
        ("pValue", value),
        ("Unit", unit),
        ("Slope", "Increasing"),
    )


def _place(where: Register, cached: bool) -> tuple[tuple[str, object], ...]:
    return (
        ("Address", f"0x{where.address:08X}"),
        ("Length", where.length),
        ("AccessMode", where.access.value),
        ("pPort", "Device"),
        ("Cachable", "WriteThrough" if cached else "NoCache"),
    )
