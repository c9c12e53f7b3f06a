"""A tier is known by its name; another word is refused."""

from __future__ import annotations

import pytest

from udccal.errors import RestorationError
from udccal.profiles.store import load_profile
from udccal.restoration.runtime import Restorer
from udccal.tiers import Tier, tier_named


def test_a_name_is_its_tier() -> None:
    assert [tier_named(tier.value) for tier in Tier] == list(Tier)
    profile = load_profile("lg55-reduced")
    assert Restorer.from_profile(profile, "preview").tier is Tier.preview


@pytest.mark.parametrize("word", ["nonsense", ""])
def test_another_word_is_refused(word: str) -> None:
    with pytest.raises(RestorationError, match="Give one of preview, fast"):
        tier_named(word)
