"""Turns the results of a fit into tables."""

from __future__ import annotations

from udccal.reports.tables import Table, number, spread
from udccal.result import FitResult

MOST_ORDERS, MOST_CHOICES = 6, 16
_NUMBERS = frozenset({1, 2})


def estimates_table(title: str, result: FitResult) -> Table:
    """Return a table with ``title`` of every estimate in ``result`` with its sigma and unit."""
    rows = tuple((e.name, number(e.value, e.sigma), spread(e.sigma), e.unit) for e in result.estimates)
    return Table(title, ("quantity", "value", "sigma", "unit"), rows, frozenset({1, 2}))


def diagnostics_table(title: str, result: FitResult) -> Table:
    """Return a table of the fit's diagnostics."""
    head = (("reduced χ²", number(result.chi2_dof), "1"), ("samples", str(result.samples), ""))
    rows = head + tuple((d.name, number(d.value), d.unit) for d in result.diagnostics)
    return Table(title, ("about the fit", "value", "unit"), rows, frozenset({1}))


def orders_table(result: FitResult) -> Table:
    """Return a table of the orders that were tried, with the chosen one marked.

    After a single choice it lists the best orders first, with their difference from the best. Successive choices have
    one criterion each: then it lists all orders as they were tried, or only the chosen ones if there are many.
    """
    if _choices(result) != 1 and more_orders(result):
        chosen = tuple((one.name, str(one.parameters)) for one in result.candidates if one.chosen)
        return Table("Orders chosen, choice by choice", ("order", "parameters"), chosen, frozenset({1}))
    if _choices(result) != 1:
        return candidates_table("Orders tried, choice by choice (lower is better)", result)
    best = sorted(result.candidates, key=lambda one: (one.criterion, one.parameters))
    rows = tuple(
        (one.name, str(one.parameters), f"{one.criterion - best[0].criterion:+.4g}", "chosen" if one.chosen else "")
        for place, one in enumerate(best)
        if place < MOST_ORDERS or one.chosen
    )
    return Table("Orders tried, best first", ("order", "parameters", "worse than the best by", ""), rows, _NUMBERS)


def more_orders(result: FitResult) -> bool:
    """Whether ``orders_table`` leaves out some orders."""
    return len(result.candidates) > (MOST_ORDERS if _choices(result) == 1 else MOST_CHOICES)


def _choices(result: FitResult) -> int:
    return sum(one.chosen for one in result.candidates)


def candidates_table(title: str, result: FitResult) -> Table:
    """Return a table of all orders that were tried, with the chosen one marked; lower is better."""
    rows = tuple(
        (c.name, str(c.parameters), f"{c.criterion:.6g}", "chosen" if c.chosen else "") for c in result.candidates
    )
    return Table(title, ("tried", "parameters", "criterion", ""), rows, _NUMBERS)


def outliers_table(title: str, result: FitResult) -> Table:
    """Return a table of the outliers: their rule, their number, and the first places."""
    rows = tuple((o.rule, str(o.count), ", ".join(o.places)) for o in result.outliers)
    return Table(title, ("rule", "count", "first places"), rows, frozenset({1}))
