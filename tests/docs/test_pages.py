"""The pages say what the program says, and their links and pictures lead somewhere."""

from __future__ import annotations

import ast
import functools
import importlib
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import udccal
from udccal.profiles.schema import VERSION
from udccal.result import FitStatus

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted((ROOT / "docs").glob("*.md"))
_MOST_BYTES = 100_000
# Shorter parts of a sentence would be found anywhere.
_LEAST_LETTERS = 8


@functools.cache
def said_by_the_program() -> str:
    """All text of the sources' strings, where each number of a sentence stands as a line's end."""
    parts = []
    for package in ("udccal", "procedures"):
        for file in sorted((ROOT / package).rglob("*.py")):
            nodes = list(ast.walk(ast.parse(file.read_text(encoding="utf-8"))))
            documented = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
            for node in nodes:
                if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in documented:
                    parts.append(" ".join(node.value.split()))
    return "\n".join(parts)


def quoted_parts(page: str) -> Iterator[str]:
    """The fixed parts of the sentences that a page's tables quote; ``...`` stands for what changes."""
    for line in page.splitlines():
        if line.startswith("|"):
            for sentence in re.findall(r'"([^"]+)"', line.split("|")[1]):
                yield from (part.strip(" ,:.;") for part in sentence.split("..."))


def unsaid(page: str) -> list[str]:
    return [p for p in quoted_parts(page) if len(p) >= _LEAST_LETTERS and p not in said_by_the_program()]


def test_troubleshooting_quotes_what_the_program_says() -> None:
    page = (ROOT / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
    assert len(list(quoted_parts(page))) > 40
    assert unsaid(page) == []


def test_troubleshooting_lists_every_status() -> None:
    page = (ROOT / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
    assert set(re.findall(r"^\| ([A-Z_]+) \|", page, re.MULTILINE)) == {status.name for status in FitStatus}


def test_a_sentence_that_nobody_says_is_noticed() -> None:
    assert unsaid('| "Expected the moon, found cheese" | | |') == ["Expected the moon, found cheese"]


@pytest.mark.parametrize("page", [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *PAGES], ids=lambda page: page.name)
def test_links_between_pages_lead_to_a_file(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text(encoding="utf-8")):
        assert (page.parent / target).is_file(), target


def test_every_page_is_in_the_sites_menu() -> None:
    menu = re.findall(r": (\w+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(menu) == [page.name for page in PAGES]


def test_pictures_are_small_and_shown() -> None:
    shown = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    pictures = list((ROOT / "docs" / "images").iterdir())
    assert pictures
    for picture in pictures:
        assert picture.stat().st_size <= _MOST_BYTES
        assert f"images/{picture.name}" in shown


def test_the_python_page_has_every_public_name() -> None:
    page = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    paths = [line.removeprefix("::: ").rsplit(".", 1) for line in page.splitlines() if line.startswith(":::")]
    assert {name for _, name in paths} >= set(udccal.__all__)
    for module, name in paths:
        assert getattr(importlib.import_module(module), name).__doc__, f"{module}.{name}"


def test_the_page_of_the_profile_is_of_its_present_version() -> None:
    page = (ROOT / "docs" / "profile.md").read_text(encoding="utf-8")
    assert re.findall(r"Format version (\d+)|`version`: (\d+)", page) == [(str(VERSION), ""), ("", str(VERSION))]
    assert re.findall(r"^Version (\d+)", page, re.MULTILINE)[0] == str(VERSION)


def test_the_tables_of_tiers_are_of_one_run() -> None:
    pages = (ROOT / "README.md", ROOT / "docs" / "tiers.md", ROOT / "docs" / "restoration.md")
    readme, tiers, restoration = (_table_of_tiers(page.read_text("utf-8")) for page in pages)
    assert readme == tiers
    assert re.findall(r"Measured at commit \S+", tiers) == re.findall(r"Measured at commit \S+", restoration) != []


def _table_of_tiers(page: str) -> str:
    return page.split("<!-- pareto lg55-reduced -->")[1].split("<!-- /pareto lg55-reduced -->")[0]
