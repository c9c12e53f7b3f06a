"""`make tables`: put the tables that `make accuracy` measured into README.md, between their markers."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable
from pathlib import Path

from tests.benchmarks.commit import stamped
from tests.benchmarks.rows import Row, table

_README = Path(__file__).resolve().parents[2] / "README.md"


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


def put_table(page: Path, marker: str, table: str, commits: Iterable[str] | None = None) -> None:
    """Put a table into a page between its markers, with the commit that it was measured at (``stamped``)."""
    text = between(page.read_text(encoding="utf-8"), marker, stamped(table, commits))
    page.write_text(text, encoding="utf-8")


def main() -> None:
    """Read the results and rewrite README.md."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--accuracy", type=Path, default=Path("accuracy"), help="folder that `make accuracy` wrote")
    folder: Path = parser.parse_args().accuracy
    rows = [Row(**row) for row in json.loads((folder / "accuracy.json").read_text(encoding="utf-8"))]
    files = sorted(folder.glob("*/scenes.md"))
    scenes = "\n\n".join(f"{file.parent.name}:\n\n{file.read_text(encoding='utf-8').strip()}" for file in files)
    text = between(_README.read_text(encoding="utf-8"), "accuracy", table(rows))
    _README.write_text(between(text, "scenes", scenes or "Not measured yet."), encoding="utf-8")


if __name__ == "__main__":
    main()
