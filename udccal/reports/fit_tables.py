"""The evidence of a fit as tables."""

from __future__ import annotations

from udccal.fitting.result import FitResult
from udccal.reports.tables import Table, number, spread


def estimates_table(title: str, result: FitResult) -> Table:
    """Every estimate of a fit with its sigma."""
    rows = tuple((e.name, number(e.value, e.sigma), spread(e.sigma), e.unit) for e in result.estimates)
    return Table(title, ("quantity", "value", "sigma", "unit"), rows, frozenset({1, 2}))


def diagnostics_table(title: str, result: FitResult) -> Table:
    """Numbers about the fit itself."""
    head = (("reduced χ²", number(result.chi2_dof), "1"), ("samples", str(result.samples), ""))
    rows = head + tuple((d.name, number(d.value), d.unit) for d in result.diagnostics)
    return Table(title, ("about the fit", "value", "unit"), rows, frozenset({1}))


def candidates_table(title: str, result: FitResult) -> Table:
    """The orders that were tried, the chosen one marked."""
    rows = tuple(
        (c.name, str(c.parameters), f"{c.criterion:.1f}", "chosen" if c.chosen else "") for c in result.candidates
    )
    return Table(title, ("tried", "parameters", "criterion", ""), rows, frozenset({1, 2}))


def outliers_table(title: str, result: FitResult) -> Table:
    """What was left out, by which rule, and where the first of it lies."""
    rows = tuple((o.rule, str(o.count), ", ".join(o.places)) for o in result.outliers)
    return Table(title, ("rule", "count", "first places"), rows, frozenset({1}))
