"""What each estimate is, in words: every fit's estimates are listed, and docs/quantities.md says the same."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import pytest

from udccal.comparison.rig_state import NAMES as STATE
from udccal.fitting.backscatter.parameters import NAMES as BACKSCATTER
from udccal.fitting.geometry.fit import _NAMES as GEOMETRY
from udccal.fitting.noise.fit import NAMES as NOISE
from udccal.fitting.psf.fit import _NUMBERS as PSF
from udccal.fitting.psf.fit import SHAPE
from udccal.fitting.wire.parameters import SHAPE_NAMES as WIRE
from udccal.profiles.units import unit_of
from udccal.quantities import Quantity, quantities, quantity
from udccal.sessions.schema import TermName

NAMES = {
    "noise": NOISE, "geometry": GEOMETRY, "wire": WIRE, "psf": (*PSF, *SHAPE, "kernel_relative_l2"),
    "backscatter": BACKSCATTER, "rig": STATE,
}  # fmt: skip


def test_every_estimate_is_listed_and_no_other() -> None:
    assert {term: set(listed) for term, listed in quantities().items()} == {t: set(n) for t, n in NAMES.items()}
    assert tuple(quantities()) == (*get_args(TermName), "rig")


@pytest.mark.parametrize("term", NAMES)
def test_words_are_short_sentences_and_units_those_of_the_names(term: str) -> None:
    for name, one in quantities()[term].items():
        assert one.what.endswith("."), name
        assert 3 <= len(one.plain) <= 32, name
        suffix = unit_of(name).replace("e-", "e")
        assert suffix in ("1", one.unit), name


def test_elements_and_strangers() -> None:
    assert quantity("wire", "fields.3.0.1.2").what == "Element [3, 0, 1, 2] of the parameter 'fields'."
    assert quantity("mine", "glow") == Quantity("1", "glow", "")


def page() -> str:
    """The tables of docs/quantities.md."""
    head = "| name | in words | unit | what it is |\n| --- | --- | --- | --- |\n"
    return "\n".join(
        f"## {term}\n{head}" + "".join(f"| `{n}` | {q.plain} | {q.unit} | {q.what} |\n" for n, q in listed.items())
        for term, listed in quantities().items()
    )


def test_the_documentation_says_the_same() -> None:
    """To write it anew: the text before the first ``##``, then ``page()``."""
    written = (Path(__file__).parents[1] / "docs" / "quantities.md").read_text(encoding="utf-8")
    assert written[written.index("## noise") :] == page()
