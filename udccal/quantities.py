"""What each estimate of a fit is: its unit, its name in plain words, and a sentence for a technician.

Fits, profiles, the report, the comparison and docs/quantities.md read one list, ``quantities.toml``.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import final


@final
@dataclass(frozen=True)
class Quantity:
    """One quantity: its unit, a short plain name, and a sentence that says what it is."""

    unit: str
    plain: str
    what: str


@cache
def quantities() -> Mapping[str, Mapping[str, Quantity]]:
    """Return all quantities, by term and by the name of the estimate; ``rig`` is the rig as all terms find it."""
    listed = tomllib.loads((resources.files("udccal") / "quantities.toml").read_text(encoding="utf-8"))
    return {term: {name: Quantity(*words) for name, words in named.items()} for term, named in listed.items()}


def quantity(term: str, name: str) -> Quantity:
    """Return what an estimate is.

    A name with dots, such as ``fields.3.0.1.2``, is an element of the term's array of that name. Of others that are not
    listed, as a user's own term may have them, nothing is known: unit 1, and no sentence.
    """
    array, *place = name.split(".")
    if place:
        return Quantity("1", name, f"Element [{', '.join(place)}] of the parameter '{array}'.")
    return quantities().get(term, {}).get(name, Quantity("1", name, ""))
