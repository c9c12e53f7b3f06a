"""Output of every verb: tables or JSON on standard output, progress and errors on standard error."""

from __future__ import annotations

import dataclasses
import enum
import json
import math
import sys
import time
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import PurePath
from typing import Any

from pydantic import BaseModel
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table as RichTable

from udccal.cli.shown_text import shown
from udccal.errors import UdccalError
from udccal.reports.tables import Table

# Width of tables that go to a file or a pipe.
_FILE_WIDTH = 120


@dataclass(frozen=True)
class StageTime:
    """How long one stage took."""

    stage: str
    seconds: float


class Stage:
    """A running stage with a progress bar; the total may become known during the stage."""

    def __init__(self, bar: Progress, name: str) -> None:
        self._bar = bar
        self._task = bar.add_task(name, total=None)

    def update(self, done: int, total: int | None = None, text: str | None = None) -> None:
        """Move the bar to ``done`` of ``total`` and show what is being done."""
        self._bar.update(self._task, completed=done, total=total)
        if text is not None:
            self._bar.update(self._task, description=shown(text))


@dataclass
class Output:
    """Where and how a verb prints.

    Attributes:
        as_json: whether standard output gets the result alone, as one JSON object.
        debug: whether tracebacks are shown.
        events: whether standard output gets events, and at last the result, as one JSON object a line.
        times: how long each stage took.
    """

    as_json: bool = False
    debug: bool = False
    events: bool = False
    times: list[StageTime] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._people = Console(stderr=True, emoji=False)
        self._bar: Progress | None = None
        self._standard = Console(width=None if sys.stdout.isatty() else _FILE_WIDTH, emoji=False)

    def say(self, sentence: str) -> None:
        """Print a sentence for the user on standard error."""
        self._people.print(shown(sentence), highlight=False, markup=False, soft_wrap=True)

    def ask(self, question: str) -> str:
        """Ask the user and wait for a line without a time limit; the progress bar pauses meanwhile.

        Raises:
            UdccalError: when standard input is closed, so that nobody can answer.
        """
        if self._bar is not None:
            self._bar.stop()
        try:
            self._people.print(shown(question), end=" ", highlight=False, markup=False, soft_wrap=True)
            return input()
        except EOFError as error:
            raise UdccalError(
                f"Expected a person to answer '{question}', found that standard input is closed. Run the command in "
                "a terminal; it continues where it stopped."
            ) from error
        finally:
            if self._bar is not None:
                self._bar.start()

    def choose(self, question: str, offered: Collection[str]) -> str:
        """Ask until the answer is one of the words that the question offers; Enter alone is the empty word.

        Raises:
            UdccalError: as ``ask`` does.
        """
        answer = self.ask(question).strip().lower()
        while answer not in offered:
            answer = self.ask(f"'{answer[:40]}' is none of the answers. {question.strip()}").strip().lower()
        return answer

    def table(self, table: Table) -> None:
        """Print a table on standard output; print nothing with ``--json`` and ``--json-events``."""
        if self.as_json or self.events:
            return
        drawn = RichTable(title=table.title, title_justify="left", title_style="bold")
        for index, column in enumerate(table.columns):
            drawn.add_column(column, justify="right" if index in table.right else "left")
        for row in table.rows:
            drawn.add_row(*map(shown, row))
        self._standard.print(drawn, markup=False)

    def answer(self, sentence: str) -> None:
        """Print a sentence that is part of the result on standard output; print nothing where a table is not."""
        if not (self.as_json or self.events):
            self._standard.print(shown(sentence), highlight=False, markup=False, soft_wrap=True)

    def result(self, result: object) -> None:
        """Print the result (a dataclass) as JSON on standard output; print nothing without ``--json``."""
        if self.events:
            self.line(result)
        elif self.as_json:
            print(json.dumps(plain(result), indent=2, allow_nan=False), flush=True)

    def line(self, event: object) -> None:
        """Print a dataclass as JSON on one line of standard output."""
        print(json.dumps(plain(event), allow_nan=False), flush=True)

    @contextmanager
    def stage(self, name: str) -> Iterator[Stage]:
        """Run a stage that may take more than a second: show a bar while it runs, and record how long it took."""
        start = time.perf_counter()
        columns = (
            SpinnerColumn(),
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
        )
        off = not self._people.is_terminal  # a file or pipe gets the times only
        with Progress(*columns, console=self._people, transient=True, disable=off) as bar:
            self._bar = bar
            try:
                yield Stage(bar, name)
            finally:
                self._bar = None
        self.times.append(StageTime(name, time.perf_counter() - start))
        self.say(f"{name}: {self.times[-1].seconds:.1f} s")


def plain(value: object) -> Any:
    """Convert a dataclass, a part of a stored file, a path, an enumeration, a number or a sequence to JSON's types.

    Numbers that are not finite become null.

    Raises:
        TypeError: for anything else.
    """
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json")
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {item.name: plain(getattr(value, item.name)) for item in dataclasses.fields(value)}
    if isinstance(value, enum.Enum):
        return value.name
    if isinstance(value, PurePath):
        return str(value)
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, (str, int)):
        return value
    raise TypeError(f"expected a value that JSON can hold, found {type(value).__name__}")
