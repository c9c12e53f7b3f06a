"""Conversion of terms to and from stored parameters, by the names of their fields.

It works on any dataclass of arrays, numbers, orders, tuples and further dataclasses of ``udccal.models``. A term that
gains a field needs no change here. Classes are looked up among the names in the term's own module, so that nothing in a
file decides which code runs.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from udccal.errors import ProfileError
from udccal.models.geometry import Geometry
from udccal.profiles import arrays
from udccal.profiles.schema import Choice, Group, Number, Numbers, Parameter, Reference, Sequence, StoredArray
from udccal.profiles.units import unit_of
from udccal.result import Estimate


@dataclass(frozen=True)
class Packed:
    """The stored form of a term."""

    parameters: tuple[Parameter, ...]
    arrays: tuple[StoredArray, ...]


def pack(term: Any, section: str, estimates: tuple[Estimate, ...], folder: Path, geometry: Geometry | None) -> Packed:
    """Store a term; large arrays become files in ``folder`` whose names begin with ``section``.

    A nested Geometry that equals ``geometry`` becomes a reference to the geometry section. A field with the name of an
    estimate is stored with the estimate's sigma.
    """
    parameters: list[Parameter] = []
    files: list[StoredArray] = []
    known = {estimate.name: estimate for estimate in estimates}

    def add(name: str, value: Any) -> None:
        unit = known[name].unit if name in known else unit_of(name)
        if isinstance(value, Geometry) and geometry is not None and _same(value, geometry):
            parameters.append(Reference(name=name, section="geometry"))
        elif dataclasses.is_dataclass(value):
            parameters.append(Group(name=name, model=type(value).__name__))
            add_fields(f"{name}.", value)
        elif isinstance(value, tuple | list):
            parameters.append(Sequence(name=name, length=len(value)))
            for index, item in enumerate(value):
                add(f"{name}.{index}", item)
        elif value is None or isinstance(value, bool | int | str):
            parameters.append(Choice(name=name, value=value))
        elif isinstance(value, float):
            _check_finite(name, value)
            sigma = known[name].sigma if name in known else None
            parameters.append(Number(name=name, value=float(value), unit=unit, sigma=sigma))
        else:
            add_array(name, np.asarray(value), unit)

    def add_array(name: str, array: np.ndarray, unit: str) -> None:
        if arrays.fits_inline(array):
            sigma = (known[name].sigma,) if name in known and array.size == 1 else None
            parameters.append(arrays.inline(name, array, unit, sigma))
        else:
            file = f"{section}_{name.replace('.', '_').lower()}.exr"
            files.append(arrays.store(folder, file, name, array, unit))

    def add_fields(prefix: str, value: Any) -> None:
        for field in dataclasses.fields(value):
            add(prefix + field.name, getattr(value, field.name))

    add_fields("", term)
    return Packed(tuple(parameters), tuple(files))


def unpack(packed: Packed, kind: type, folder: Path, geometry: Geometry | None) -> Any:
    """Return the term of class ``kind`` that ``pack`` stored.

    Raises:
        ProfileError: when a field is missing, unknown or of the wrong type, or an array's file is missing or altered.
    """
    entries = (*packed.parameters, *packed.arrays)
    stored = {entry.name: entry for entry in entries}
    if len(stored) < len(entries):
        twice = next(entry.name for entry in entries if stored[entry.name] is not entry)
        raise ProfileError(
            f"Expected each parameter of {kind.__name__} once, found '{twice}' twice. Restore the profile from a copy."
        )
    allowed = _classes_beside(kind)
    used: set[str] = set()

    def take(name: str) -> Any:
        if name not in stored:
            raise ProfileError(
                f"Expected the parameter '{name}' of {kind.__name__}, found none. Restore the profile from a copy."
            )
        used.add(name)
        entry = stored[name]
        match entry:
            case Number() | Choice():
                return entry.value
            case Numbers():
                return arrays.from_inline(entry)
            case StoredArray():
                return arrays.load(folder, entry)
            case Sequence():
                return tuple(take(f"{name}.{index}") for index in range(entry.length))
            case Reference():
                return _shared(geometry, name)
            case Group():
                if entry.model not in allowed:
                    raise ProfileError(f"Expected a known model for '{name}', found '{entry.model}'. Update udccal.")
                return build(allowed[entry.model], f"{name}.")

    def build(cls: type, prefix: str) -> Any:
        return _construct(cls, {field.name: take(prefix + field.name) for field in dataclasses.fields(cls)})

    term = build(kind, "")
    unknown = sorted(set(stored) - used)
    if unknown:
        raise ProfileError(
            f"Expected only parameters of {kind.__name__}, found '{unknown[0]}' too. Update udccal, or restore the "
            "profile from a copy."
        )
    return term


def _construct(cls: Callable[..., Any], fields: dict[str, Any]) -> Any:
    try:
        return cls(**fields)
    except (TypeError, ValueError) as error:
        raise ProfileError(
            f"Expected parameters that make a {getattr(cls, '__name__', cls)}, found: {str(error).splitlines()[0]}. "
            "Restore the profile from a copy."
        ) from error


def _classes_beside(kind: type) -> dict[str, type]:
    """Return the dataclasses of ``udccal.models``, or of the term's own module, that the term's module names."""
    names = vars(sys.modules[kind.__module__])
    return {
        name: value
        for name, value in names.items()
        if isinstance(value, type)
        and dataclasses.is_dataclass(value)
        and (value.__module__.startswith("udccal.models") or value.__module__ == kind.__module__)
    }


def _shared(geometry: Geometry | None, name: str) -> Geometry:
    if geometry is None:
        raise ProfileError(
            f"Expected '{name}' to be stored itself, found a reference. Restore the profile from a copy."
        )
    return geometry


def _same(a: Geometry, b: Geometry) -> bool:
    return all(np.array_equal(getattr(a, field.name), getattr(b, field.name)) for field in dataclasses.fields(Geometry))


def _check_finite(name: str, value: float) -> None:
    if not np.isfinite(value):
        raise ProfileError(f"Expected a finite value of '{name}', found {value}. Do not store this fit.")
