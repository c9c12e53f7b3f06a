"""The page in a browser: a person clicks through a capture, does wrong, and reloads."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.chromium import Page, chromium
from tests.web.looks import SIZES, check_layout, says, see_the_picture
from tests.web.serving import Served, played
from udccal.guide.events import Answer, StepEvent, VerdictEvent


def go_through(page: Page, served: Served) -> None:
    """Lead the person through the play, with a wrong placing, a slip, a way back and a reload."""
    says(page, "Step 1 of 3")
    see_the_picture(page)
    check_layout(page)
    page.tap("button.go")
    says(page, "The step is captured.")
    page.tap("button.go")
    says(page, "Step 2 of 3")
    says(page, "Move it")
    page.wait("document.querySelectorAll('#outlines .wanted, #outlines .seen').length === 2")
    page.wait("document.querySelector('#readings .bad') && document.querySelector('#readings .good')")
    check_layout(page)

    page.reload()
    says(page, "Step 2 of 3")
    see_the_picture(page)
    page.tap("button.go")
    says(page, "The LED moved by 3 px during a bracket.")
    assert page.run("document.querySelector('button.first').dataset.answer") == "again"
    check_layout(page)
    page.tap("button.quit")  # a slip: it asks once more
    says(page, "Really stop?")
    page.tap("button.again")
    says(page, "Start")
    page.tap("button.go")
    says(page, "The step is captured.")
    page.tap("button.back")
    says(page, "Step 1 of 3")
    page.tap("button.skip")
    says(page, "Step 2 of 3")
    page.tap("button.skip")
    says(page, "Step 3 of 3")
    check_layout(page)
    page.tap("button.go")
    says(page, "The step is captured.")
    page.tap("button.go")
    says(page, "Captured 2 steps.")
    check_layout(page)
    served.thread.join(10.0)


@pytest.mark.medium
def test_a_person_is_led_through_at_every_width(tmp_path: Path) -> None:
    with chromium(tmp_path) as browser:
        for width, height in SIZES:
            with played() as served:
                page = browser.open(served.address, width, height)
                go_through(page, served)
                assert page.errors == []
                own = (served.address, "data:")
                assert [address for address in page.requests if not address.startswith(own)] == []
                assert [answer.value for _, answer in served.capture.answered] == (
                    ["go", "go", "go", "again", "go", "back", "skip", "skip", "go", "go"]
                )


def test_a_second_window_watches_and_its_buttons_come_back_with_the_lead(tmp_path: Path, served: Served) -> None:
    with chromium(tmp_path) as browser:
        first, second = (browser.open(served.address, 390, 844) for _ in range(2))
        for page in (first, second):
            page.wait("document.querySelector('button.go')")
        first.tap("button.go")
        says(second, "The step is captured.")
        says(second, "Another window leads.")
        assert second.run("document.querySelectorAll('button').length") == 0
        assert second.run("give('quit', 2).then(() => document.querySelector('#said').textContent)") != ""
        assert served.capture.answered == [("noise/dark", Answer.go)]
        first.reload()
        first.tap("button.go")
        for page in (first, second):
            says(page, "Step 2 of 3")
            see_the_picture(page)


@pytest.mark.medium
def test_the_page_says_when_the_capture_is_gone(tmp_path: Path) -> None:
    with chromium(tmp_path) as browser:
        with played() as served:
            page = browser.open(served.address, 390, 844)
            says(page, "Step 1 of 3")
            served.capture.person.tell = lambda event: None  # type: ignore[method-assign]  # it breaks without a word
        says(page, "The capture does not answer.")


def test_texts_and_drawings_neither_run_nor_write_into_the_page(tmp_path: Path, served: Served) -> None:
    runs = "<script>window.ran = true</script><img src=x onerror='window.ran = true'>"
    drawing = f'<svg xmlns="http://www.w3.org/2000/svg" onload="window.ran = true">{runs}</svg>'
    with chromium(tmp_path) as browser:
        page = browser.open(served.address, 390, 844)
        says(page, "Step 1 of 3")
        served.capture.person.tell(StepEvent(runs, runs, runs, runs, drawing, 1, 1, 1.0))
        served.capture.person.tell(VerdictEvent(runs, False, runs, (Answer.go,)))
        says(page, "Step 1 of 1")
        page.wait(
            "document.querySelector('#drawing').complete && document.querySelector('#said').innerText.length > 60"
        )
        assert page.run("window.ran") is None
        assert page.run("document.querySelectorAll('img').length") == 2
