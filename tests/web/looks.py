"""What tests look for on the page of a guided capture."""

from __future__ import annotations

import json
from typing import Final

from tests.chromium import Page

# Widths and heights of a telephone, a tablet and a computer.
SIZES: Final = ((390, 844), (820, 1180), (1280, 800))


def says(page: Page, words: str) -> None:
    page.wait(f"document.body.innerText.includes({json.dumps(words)})")


def check_layout(page: Page) -> None:
    """Nothing sticks out, no button is too small for a finger or out of reach, and no word is broken."""
    assert not page.scrolls_sideways
    sizes = page.run(
        "[...document.querySelectorAll('button')].map(each => {"
        "  const box = each.getBoundingClientRect();"
        "  return [box.width, box.height, box.left, innerHeight - box.bottom, each.scrollWidth - each.clientWidth];"
        "})"
    )
    for width, height, left, below, hidden in sizes:
        assert min(width, height) >= 48
        assert min(left, below) >= 0
        assert hidden <= 0


def see_the_picture(page: Page) -> None:
    """A live picture of the full width that is allowed, and a newer one soon."""
    page.wait("document.querySelector('#frame').naturalWidth > 0")
    before = page.run("known.view")
    page.wait(f"known.view > {before}")
