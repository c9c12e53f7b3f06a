from __future__ import annotations

import pytest

from udccal.errors import UdccalError
from udccal.planning.plan import parse_targets


def test_targets_come_in_the_order_of_the_terms() -> None:
    found = parse_targets(["psf=2%", "wire=0.05%", "geometry=0.1px", "noise=1e0%"])
    assert list(found.items()) == [("noise", 1.0), ("geometry", 0.1), ("wire", 0.05), ("psf", 2.0)]


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("focus=1%", "found one for 'focus'"),
        ("wire=1px", "in %, found the unit 'px'"),
        ("geometry=1%", "in px"),
        ("wire=1", "found the unit none"),
        ("wire=0%", "above zero"),
        ("wire=-1%", "above zero"),
        ("wire=nan%", "found 'wire=nan%'"),
        ("wire=1..2%", "above zero"),
        ("wire", "found 'wire'"),
        ("wire=", "found 'wire='"),
        ("", "found ''"),
    ],
)
def test_what_is_no_target_is_refused_with_an_example(word: str, said: str) -> None:
    with pytest.raises(UdccalError, match="Expected") as caught:
        parse_targets([word])
    assert said in str(caught.value)
    assert "wire=0.05%" in str(caught.value)


def test_a_term_has_one_target() -> None:
    with pytest.raises(UdccalError, match="one target for wire, found 2"):
        parse_targets(["wire=1%", "wire=2%"])
