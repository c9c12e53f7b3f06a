"""Finds installed procedures and sinks by their names through entry points."""

from __future__ import annotations

import functools
from importlib.metadata import EntryPoint, EntryPoints, entry_points

from udccal.errors import UdccalError

PROCEDURES = "udccal.procedures"
SINKS = "udccal.sinks"


def find_procedure(term: str) -> type:
    """Return the class of the procedure of ``term``; that of another package comes before udccal's own.

    Raises:
        UdccalError: when none is installed, two other packages provide one, or it cannot be imported.
    """
    return _find(PROCEDURES, term, f"procedure for the term '{term}'")


def find_sink(name: str) -> type:
    """Return the class of the sink ``name`` of a live run; that of another package comes before udccal's own.

    Raises:
        UdccalError: as ``find_procedure``.
    """
    return _find(SINKS, name, f"sink '{name}'")


def _find(group: str, name: str, what: str) -> type:
    found = _installed(group).select(name=name)
    others = [point for point in found if not _is_our_own(point)]
    if not found:
        present = ", ".join(sorted({point.name for point in _installed(group)})) or "nothing"
        raise UdccalError(
            f"Expected an installed {what}, found none in the entry-point group '{group}', which has {present}. "
            "Choose one of these, install udccal with pip, or install the package that provides it."
        )
    if len(others) > 1:
        values = " and ".join(point.value for point in others)
        raise UdccalError(f"Expected one {what}, found {values}. Uninstall the package you do not want.")
    return _load(next(iter(others or found)), what)


@functools.cache
def _installed(group: str) -> EntryPoints:
    """Return the entry points of a group; reading the metadata of all packages takes 20 ms, so it is done once."""
    return entry_points(group=group)


def _is_our_own(point: EntryPoint) -> bool:
    return point.value.startswith(("procedures.", "udccal."))


def _load(point: EntryPoint, what: str) -> type:
    try:
        loaded = point.load()
    except (ImportError, AttributeError) as error:
        raise UdccalError(
            f"Expected the {what} at {point.value}, found: {error}. Reinstall the package it is from."
        ) from error
    if not isinstance(loaded, type):
        raise UdccalError(f"Expected the {what} at {point.value} to be a class, found {loaded!r}.")
    return loaded
