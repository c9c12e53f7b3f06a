"""Reports and comparisons as a phone, a tablet and a desk show them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import pytest

from tests.chromium import Browser, Page, chromium
from tests.reports.test_page import page as report
from tests.reports.test_page import section, wide_page
from udccal.reports.page import Advice, DiffPage, DiffSection, Fact, ValidationPage, ValidationSection, render
from udccal.reports.tables import Table

pytestmark = pytest.mark.medium
SIZES = ((390, 844), (820, 1180), (1280, 800))


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with chromium(tmp_path_factory.mktemp("browser")) as browser:
        yield browser


def comparison() -> str:
    """The page of a comparison, with long names and wide tables."""
    table = Table(
        "Estimates", ("quantity", "A", "B − A", "in σ"), (("a long plain name [unit]", *["1.23456789"] * 3),) * 9
    )
    section = DiffSection(
        "wire", "changed, harmless", "χ² is 2870 for 10 estimates. " * 4, table, (), table, ("n" * 200,)
    )
    return render(
        DiffPage(
            title="Two profiles of toy",
            advice=Advice("The profiles differ, but nobody would see it.", "harmless", ("Go on with A. " * 5,)),
            facts=(Fact("A made", "2024-05-01T12:00:00+00:00"), Fact("lost", "0.01 dB")),
            movement_sentence="The camera moved.",
            movement=table,
            sections=(section,) * 5,
        )
    )


def validation() -> str:
    """The page of a validation, which that of a check is too."""
    rows = (("a long name of a check", "1.23456789", "2", "%", "ok"),) * 9
    table = Table("Checks", ("check", "value", "limit", "unit", ""), rows)
    section = ValidationSection("wire", "predicted", "good", ("What was predicted. " * 5,), table, ())
    advice = Advice("The profile holds.", "good", ("Go on with this profile.",))
    return render(ValidationPage("A profile of toy", advice, (Fact("session", "another one"),), (section,) * 5))


def check_shown(page: Page, height: int) -> None:
    """Nothing from outside, nothing wrong, nothing sticks out, and the advice is read first, without scrolling."""
    assert page.errors == []
    assert [asked for asked in page.requests if not asked.startswith(("file:", "data:"))] == []
    assert not page.scrolls_sideways
    top, bottom, first = page.run(
        "(card => [card.top, card.bottom, document.querySelector('table').getBoundingClientRect().top])"
        "(document.querySelector('.advice').getBoundingClientRect())"
    )
    assert 0 <= top < bottom < height
    assert bottom <= first


def opened(browser: Browser, file: Path, text: str, width: int, height: int) -> Page:
    file.write_text(text, encoding="utf-8")
    page = browser.open(file.as_uri(), width, height)
    page.run("document.querySelectorAll('details').forEach(each => each.open = true)")
    return page


@pytest.mark.parametrize(("width", "height"), SIZES)
@pytest.mark.parametrize("make", [wide_page, comparison, validation])
def test_a_page_can_be_read(browser: Browser, tmp_path: Path, make: object, width: int, height: int) -> None:
    assert callable(make)
    page = opened(browser, tmp_path / "page é.html", make(), width, height)
    check_shown(page, height)
    assert "toy" in page.text


def test_a_label_stays_on_one_line(browser: Browser, tmp_path: Path) -> None:
    page = opened(browser, tmp_path / "page.html", wide_page(), 390, 844)
    lines = "each => (text => (text.selectNodeContents(each), text.getClientRects().length))(document.createRange())"
    assert page.run(f"[...document.querySelectorAll('dt')].map({lines})") == [1]


def test_a_table_of_many_columns_is_not_squeezed_between_others(browser: Browser, tmp_path: Path) -> None:
    estimates = Table("Fitted", ("quantity", "value", "before", "name"), (("two words", "1", "a ± b", "n" * 50),) * 3)
    others = tuple(Table(name, ("order", "parameters"), (("rows", "8"),)) for name in ("Accuracy", "Orders"))
    text = render(report(replace(section(), tables=(estimates, *others))))
    page = opened(browser, tmp_path / "page.html", text, 1280, 800)
    inside = "each => each.scrollWidth <= each.clientWidth && each.querySelector('td').getClientRects()[0].height < 40"
    assert page.run(f"[...document.querySelectorAll('.body .table')].map({inside})") == [True] * 3


def test_a_shadow_tells_that_a_table_goes_on(browser: Browser, tmp_path: Path) -> None:
    page = opened(browser, tmp_path / "page.html", wide_page(), 390, 844)
    table = "document.querySelector('.table')"
    page.run(f"{table}.scrollIntoView()")

    def edges() -> list[bool]:
        left, right, top = page.run(f"(b => [b.left, b.right, b.top])({table}.getBoundingClientRect())")
        page.screenshot(tmp_path / "shown.png")
        shown = cv2.imread(str(tmp_path / "shown.png"))
        assert shown is not None
        return [bool(shown[int(top) + 3, int(x)].max() < 240) for x in (left + 1, right - 2)]

    assert edges() == [False, True]
    page.run(f"{table}.scrollLeft = 1e6")
    assert edges() == [True, False]


@pytest.mark.parametrize(
    "broken",
    [
        '<img src="http://127.0.0.1:9/picture.png">',
        "<script>undefined_function()</script>",
        '<div style="width: 2000px">wide</div>',
        '<div style="height: 5000px"></div>',
    ],
)
def test_what_is_wrong_with_a_page_is_noticed(browser: Browser, tmp_path: Path, broken: str) -> None:
    text = comparison().replace("<main>", f"<main>{broken}")
    with pytest.raises(AssertionError):
        check_shown(opened(browser, tmp_path / "broken.html", text, 390, 844), 844)
