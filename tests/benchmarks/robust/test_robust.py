"""The judge of `make robust` rejects what is silently wrong, and a few data sets of each family pass it."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable
from dataclasses import replace

import pytest

from tests.benchmarks.robust.family import Answer, Case, Family, Kind, Number, judge
from tests.benchmarks.robust.run import family, rows_of
from udccal.errors import FitError

GOOD = Answer(True, ("A note.",), (Number("a", 0.1, 0.1, 0.09), Number("b", 0.0, 0.0)), True)


def answered(answer: Answer) -> Kind:
    return judge(Case("a case", lambda: answer), 0).kind


def raising(error: Exception) -> Callable[[], Answer]:
    def answer() -> Answer:
        raise error

    return answer


def test_what_holds_is_told_or_is_refused_passes() -> None:
    assert answered(GOOD) is Kind.HELD
    far = Number("a", 1.0, 0.1, words=("off",))
    assert answered(replace(GOOD, numbers=(far,), notes=("a may be off.",))) is Kind.TOLD
    assert answered(replace(GOOD, usable=False)) is Kind.REFUSED
    assert judge(Case("a case", raising(FitError("Expected a, found b. Do c."))), 0).kind is Kind.REFUSED


@pytest.mark.parametrize(
    ("answer", "kind"),
    [
        (replace(GOOD, numbers=(Number("a", 1.0, 0.1),)), Kind.SILENT),
        (replace(GOOD, numbers=(Number("a", 1.0, 0.1, words=("off",)),)), Kind.SILENT),
        (replace(GOOD, numbers=(Number("b", 1e-9, 0.0),)), Kind.SILENT),
        (replace(GOOD, numbers=(Number("a", math.nan, 0.1),)), Kind.SILENT),
        (replace(GOOD, numbers=(Number("a", 0.1, math.nan),)), Kind.SILENT),
        (replace(GOOD, finite=False), Kind.NOT_FINITE),
        (replace(GOOD, usable=False, notes=()), Kind.SILENT),
    ],
)
def test_what_is_silently_wrong_is_rejected(answer: Answer, kind: Kind) -> None:
    assert answered(answer) is kind


def test_a_raw_error_is_rejected() -> None:
    found = judge(Case("a case", raising(ZeroDivisionError("division by zero"))), 0)
    assert found.kind is Kind.RAW_ERROR
    assert not found.ok
    assert not all(row.ok for row in rows_of(Family("a", lambda seed: Case("", lambda: GOOD)), [found]))


def test_rows_reject_wide_sigmas_and_refusals() -> None:
    drawn = Family("a", lambda seed: Case("", lambda: GOOD))
    good = [judge(Case("a case", lambda: GOOD), seed) for seed in range(20)]
    assert all(row.ok for row in rows_of(drawn, good))
    wide = replace(GOOD, numbers=(Number("a", 0.1, 0.2, 0.1),))
    assert not all(row.ok for row in rows_of(drawn, [judge(Case("", lambda: wide), 0)]))
    refused = [judge(Case("", raising(FitError("No."))), seed) for seed in range(2)]
    assert not all(row.ok for row in rows_of(drawn, [*good, *refused]))


@pytest.mark.parametrize(
    ("cpu_s", "MiB", "work", "missed"),
    [
        (14.0, 90.0, 1.0, 0),
        (16.0, 90.0, 1.0, 1),
        (16.0, 90.0, 0.3, 1),
        (19.0, 90.0, 1.33, 0),
        (21.0, 90.0, 1.33, 1),
        (14.0, 101.0, 1.0, 1),
        (14.0, 101.0, 1.33, 0),
    ],
)
def test_rows_reject_what_costs_more_than_its_size_allows(cpu_s: float, MiB: float, work: float, missed: int) -> None:
    drawn = Family("a", lambda seed: Case("", lambda: GOOD), most_cpu_s=15.0, most_MiB=100.0)
    good = replace(judge(Case("a case", lambda: GOOD), 0), cpu_s=1.0, peak_MiB=1.0)
    dear = replace(good, cpu_s=cpu_s, peak_MiB=MiB, work=work)
    assert sum(not row.ok for row in rows_of(drawn, [good, dear])) == missed


@pytest.mark.parametrize(
    ("name", "seeds"),
    [
        ("noise", (10,)),
        ("hdr", (0, 2, 11)),
        pytest.param("geometry", (1, 9), marks=pytest.mark.medium),
    ],
)
def test_data_sets_of_the_families_hold(name: str, seeds: tuple[int, ...]) -> None:
    for seed in seeds:
        found = judge(family(name).draw(seed), seed)
        assert found.ok, found


def test_the_judge_rejects_a_fit_whose_sigmas_are_five_times_too_small(monkeypatch: pytest.MonkeyPatch) -> None:
    module = importlib.import_module("tests.benchmarks.robust.noise")
    measure = module.measure

    def overconfident(*arguments: object) -> object:
        result = measure(*arguments)
        return replace(result, estimates=tuple(replace(one, sigma=one.sigma / 5) for one in result.estimates))

    monkeypatch.setattr(module, "measure", overconfident)
    assert judge(module.draw(10), 10).kind is Kind.SILENT
