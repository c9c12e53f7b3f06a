"""How a page lies in windows of several widths, in a Chromium without a screen."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest

_CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
# Frames of the widths asked for: a window without a screen has a least width of its own.
_MEASURE = """
const found = [];
for (const width of WIDTHS) {
  const frame = document.createElement('iframe');
  frame.style.cssText = `width:${width}px;height:900px;border:0`;
  frame.onload = () => {
    const page = frame.contentDocument, root = page.documentElement, outside = [];
    for (const each of page.querySelectorAll('details')) each.open = true;
    for (const card of page.querySelectorAll('section, nav a, dl')) {
      const right = card.getBoundingClientRect().right + 0.5;
      for (const each of card.querySelectorAll('*')) {
        const scrolls = each.parentElement.closest('.table') !== null;
        if (!scrolls && each.getBoundingClientRect().right > right) outside.push(each.tagName.toLowerCase());
      }
    }
    const tables = [...page.querySelectorAll('.table')];
    found.push({
      width: width, sideways: root.scrollWidth > root.clientWidth, outside: outside,
      scrolling: tables.filter(each => each.scrollWidth > each.clientWidth).length,
    });
    if (found.length < WIDTHS.length) return;
    const said = document.createElement('pre');
    said.textContent = JSON.stringify(found);
    document.body.replaceChildren(said);
  };
  frame.srcdoc = PAGE;
  document.body.append(frame);
}
"""


@dataclass(frozen=True)
class Layout:
    """A page in a window: whether the page scrolls sideways, what lies outside its card, how many tables scroll."""

    width: int
    sideways: bool
    outside: tuple[str, ...]
    scrolling: int


def layouts(page: str, folder: Path, widths: Sequence[int] = (320, 390, 820, 1280)) -> tuple[Layout, ...]:
    """Open a page with every detail unfolded; skip the test where there is no Chromium."""
    if _CHROMIUM is None:
        pytest.skip("needs Chromium, which this machine lacks")
    constants = f"const PAGE = {json.dumps(page)}, WIDTHS = {json.dumps(list(widths))};".replace("</", "<\\/")
    file = folder / "measure.html"
    file.write_text(f"<!doctype html><meta charset=utf-8><body><script>{constants}{_MEASURE}</script>", "utf-8")
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=20000", "--dump-dom"]
    command = [_CHROMIUM, *flags, f"--user-data-dir={folder / 'chromium'}", file.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=200)
    said = re.search(r"<pre>(.*)</pre>", done.stdout, re.DOTALL)
    assert said is not None, done.stderr
    found = json.loads(html.unescape(said[1]))
    return tuple(Layout(one["width"], one["sideways"], tuple(one["outside"]), one["scrolling"]) for one in found)
