"""`make tables`: put the tables that `make accuracy` measured into docs/accuracy.md, between their markers."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path

from tests.benchmarks.accuracy import finished, summaries, table
from tests.benchmarks.commit import stamped

_PAGE = Path(__file__).resolve().parents[2] / "docs" / "accuracy.md"


def between(text: str, marker: str, content: str) -> str:
    """``text`` with what stands between the two comments named ``marker`` replaced.

    Raises:
        ValueError: when the markers are not there.
    """
    first, last = f"<!-- {marker} -->", f"<!-- /{marker} -->"
    start, end = text.find(first), text.find(last)
    if start < 0 or end < start:
        raise ValueError(f"Expected the markers {first} and {last} in the page, found them missing. Put them back.")
    return f"{text[: start + len(first)]}\n{content.strip()}\n{text[end:]}"


def has_table(page: Path, marker: str) -> bool:
    """Whether a page has a place for a table."""
    return f"<!-- {marker} -->" in page.read_text(encoding="utf-8")


def put_table(page: Path, marker: str, table: str, commits: Iterable[str] | None = None) -> None:
    """Put a table into a page between its markers, with the commit that it was measured at (``stamped``)."""
    text = between(page.read_text(encoding="utf-8"), marker, stamped(table, commits))
    page.write_text(text, encoding="utf-8")


def write_tables(folder: Path, page: Path) -> None:
    """Put the finished parts of ``make accuracy`` into a page, with the commits of the measurement, not of this."""
    parts = finished(folder)
    commits = [part.commit for part in parts]
    put_table(page, "accuracy", table(summaries(parts)), commits)
    files = sorted(folder.glob("*/scenes.md"))
    scenes = "\n\n".join(f"{file.parent.name}:\n\n{file.read_text(encoding='utf-8').strip()}" for file in files)
    put_table(page, "scenes", scenes or "Not measured yet.", commits)


def main() -> None:
    """Read the results and rewrite the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--accuracy", type=Path, default=Path("accuracy"), help="folder that `make accuracy` wrote")
    write_tables(parser.parse_args().accuracy, _PAGE)


if __name__ == "__main__":
    main()
