"""Data sets drawn from wide families, and what must come of each: numbers that hold, or words that say what is wrong.

To add a family, write ``tests/benchmarks/robust/<name>.py`` with

    def draw(seed: int) -> Case: ...
    FAMILY = Family("<name>", draw)

and add ``"<name>"`` to ``MODULES`` in run.py. ``draw`` draws everything from ``numpy.random.default_rng([seed, tag])``
and returns at once; ``Case.answer`` makes the data, fits them and returns an ``Answer``. ``judge`` catches what is
raised, and the seconds and the memory are measured for each family in a process of its own. A case that is ``sound``
lies inside what the fit claims to describe: an error or a bad status is then a miss beyond a tolerated part.
"""

from __future__ import annotations

import enum
import math
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass

import jax
import numpy as np

from tests.benchmarks.memory import peak_MiB, reset_peak
from udccal.errors import UdccalError
from udccal.result import FitResult

# Of the errors in units of the stated sigma, and of the median stated sigma in units of its bound.
WORST_Z, MOST_OVER_BOUND = 4.5, 1.5


@dataclass(frozen=True)
class Number:
    """A stated quantity against the truth.

    Attributes:
        name: of the quantity.
        error: stated value less the truth.
        sigma: stated standard deviation.
        bound: the Cramér–Rao bound on it; nan where none is known.
        words: a note with one of these says that the quantity may be off; "" stands for any note.
    """

    name: str
    error: float
    sigma: float
    bound: float = math.nan
    words: tuple[str, ...] = ()

    @property
    def z(self) -> float:
        """The error in sigma; a sigma of 0 allows no error, and nan none at all."""
        z = abs(self.error) / self.sigma if self.sigma > 0 else (0.0 if self.error == 0 else math.inf)
        return z if z == z else math.inf

    def told_by(self, notes: tuple[str, ...]) -> bool:
        """Whether a note says that this quantity may be off."""
        return any(word in note for word in self.words for note in notes)


@dataclass(frozen=True)
class Answer:
    """What a fit said of one data set; ``usable`` is whether its status says that the numbers may be used."""

    usable: bool
    notes: tuple[str, ...]
    numbers: tuple[Number, ...]
    finite: bool


@dataclass(frozen=True)
class Case:
    """One data set: what was drawn, and the function that makes it and fits it.

    ``work`` is how large it is, in units of what the family's limits of time and memory are stated for.
    """

    what: str
    answer: Callable[[], Answer]
    sound: bool = True
    work: float = 1.0


@dataclass(frozen=True)
class Family:
    """Where data sets come from, and what their fits may cost.

    ``most_refused`` is the part of the sound data sets that may end in an error or a bad status. Time may grow with a
    data set's ``work``; memory counts of data sets up to 1.
    """

    name: str
    draw: Callable[[int], Case]
    most_refused: float = 0.05
    most_cpu_s: float = math.inf
    most_MiB: float = math.inf


class Kind(enum.Enum):
    """What came of a data set; the value says it in words."""

    HELD = "every number held"
    TOLD = "numbers are off, and notes name them"
    REFUSED = "an error or a status that says what is wrong"
    SILENT = "numbers are off, and nothing says so"
    RAW_ERROR = "an error that is no sentence for a person"
    NOT_FINITE = "numbers that are not finite"


@dataclass(frozen=True)
class Verdict:
    """Of one data set; ``size`` is its worst error in sigma of which no note tells, and ``why`` names it."""

    seed: int
    what: str
    sound: bool
    kind: Kind
    size: float
    why: str
    numbers: tuple[Number, ...]
    cpu_s: float
    peak_MiB: float
    work: float = 1.0

    @property
    def ok(self) -> bool:
        """Whether nothing wrong was silent."""
        return self.kind in (Kind.HELD, Kind.TOLD, Kind.REFUSED)


def judge(case: Case, seed: int) -> Verdict:
    """Run a case and judge what it says."""
    reset_peak()
    start = time.process_time()
    try:
        answer = case.answer()
        kind, size, why = _judged(answer)
        numbers = answer.numbers if answer.usable else ()
    except UdccalError as error:
        kind, size, why, numbers = Kind.REFUSED, 0.0, str(error), ()
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        found = f"{type(error).__name__}: {error} ({place.name}, line {place.lineno})"
        kind, size, why, numbers = Kind.RAW_ERROR, math.inf, found, ()
    cost = time.process_time() - start, peak_MiB()
    return Verdict(seed, case.what, case.sound, kind, size, why, numbers, *cost, case.work)


def _judged(answer: Answer) -> tuple[Kind, float, str]:
    """The kind, the worst error that nothing tells, and what it is of."""
    if not answer.finite:
        return Kind.NOT_FINITE, math.inf, "; ".join(answer.notes)
    if not answer.usable:
        return (
            (Kind.REFUSED, 0.0, " ".join(answer.notes))
            if answer.notes
            else (Kind.SILENT, math.inf, "a status, no advice")
        )
    off = [number for number in answer.numbers if number.z > WORST_Z]
    silent = [number for number in answer.numbers if not (number.z > WORST_Z and number.told_by(answer.notes))]
    worst = max(silent, key=lambda number: number.z, default=None)
    size, name = (worst.z, worst.name) if worst else (0.0, "")
    if size > WORST_Z:
        return Kind.SILENT, size, name
    return (Kind.TOLD, size, ", ".join(number.name for number in off)) if off else (Kind.HELD, size, name)


def all_finite(*parts: object) -> bool:
    """Whether every number of these arrays, objects and terms is finite."""
    return all(bool(np.isfinite(np.asarray(leaf, np.float64)).all()) for leaf in jax.tree.leaves(parts))


def of_result(result: FitResult, numbers: tuple[Number, ...]) -> Answer:
    """The answer of a fit's result, with the numbers that are judged."""
    stated = [(one.value, one.sigma) for one in result.estimates]
    finite = all_finite(result.term, stated, result.cov, result.chi2_dof)
    return Answer(result.ok, result.notes, numbers, finite)
