"""Finds installed procedures by the name of their term through entry points."""

from __future__ import annotations

from importlib.metadata import EntryPoint, entry_points

from udccal.errors import UdccalError

GROUP = "udccal.procedures"


def find_procedure(term: str) -> type:
    """Return the class of the procedure of ``term``; that of another package comes before udccal's own.

    Raises:
        UdccalError: when none is installed, two other packages provide one, or it cannot be imported.
    """
    found = entry_points(group=GROUP, name=term)
    others = [point for point in found if not _is_our_own(point)]
    if not found:
        raise UdccalError(
            f"Expected an installed procedure for the term '{term}', found none in the entry-point group '{GROUP}'. "
            "Install udccal with pip, or install the package that provides the procedure."
        )
    if len(others) > 1:
        values = " and ".join(point.value for point in others)
        raise UdccalError(
            f"Expected one procedure for the term '{term}', found {values}. Uninstall the package you do not want."
        )
    return _load(next(iter(others or found)))


def _is_our_own(point: EntryPoint) -> bool:
    return point.value.startswith("procedures.")


def _load(point: EntryPoint) -> type:
    try:
        loaded = point.load()
    except (ImportError, AttributeError) as error:
        raise UdccalError(
            f"Expected the procedure '{point.name}' at {point.value}, found: {error}. Reinstall the package it is from."
        ) from error
    if not isinstance(loaded, type):
        raise UdccalError(f"Expected the procedure '{point.name}' at {point.value} to be a class, found {loaded!r}.")
    return loaded
