"""Turns the results of a fit into tables."""

from __future__ import annotations

import numpy as np

from udccal.comparison.estimates import ANGLES
from udccal.comparison.limits import DiffLimits
from udccal.comparison.rig_state import RigState
from udccal.fitting.geometry.bundle import INTRINSIC_NAMES
from udccal.models.geometry import Geometry
from udccal.mounting import angles_deg
from udccal.quantities import quantity
from udccal.reports.tables import Table, number, spread
from udccal.result import Estimate, FitResult, FitStatus

MOST_ORDERS, MOST_CHOICES = 6, 16
_NUMBERS = frozenset({1, 2})


def estimates_table(title: str, result: FitResult) -> Table:
    """Return a table with ``title`` of every estimate in ``result`` with its sigma and unit, and what was known before.

    Elements of the term's arrays are left out: they mean nothing on their own.
    """
    rows = tuple(
        (quantity(result.name, e.name).plain, number(e.value, e.sigma), spread(e.sigma), e.unit, _before(e), e.name)
        for e in result.numbers
    )
    return Table(title, ("quantity", "value", "sigma", "unit", "before the data", "name"), rows, _NUMBERS)


def imported_numbers(result: FitResult) -> dict[str, float]:
    """Return a lens from another program's file under the names of a fit's estimates; empty for any other result.

    It has no estimates, since nobody knows its error bars.
    """
    lens = result.term
    if result.status is not FitStatus.IMPORTED or not isinstance(lens, Geometry):
        return {}
    values = (lens.focal_px, lens.principal_point_px, lens.distortion, angles_deg(np.asarray(lens.rotation_rad)))
    return dict(zip((*INTRINSIC_NAMES, *ANGLES), np.concatenate(values).tolist(), strict=True))


def imported_table(title: str, result: FitResult) -> Table:
    """Return a table with ``title`` of the numbers of an imported lens."""
    told = [(quantity(result.name, name), name, value) for name, value in imported_numbers(result).items()]
    rows = tuple((q.plain, f"{value:.6g}", q.unit, name) for q, name, value in told)
    return Table(title, ("quantity", "value", "unit", "name"), rows, frozenset({1}))


def meanings_table(result: FitResult) -> Table:
    """Return a table of what each estimate is."""
    meant = [(e.name, quantity(result.name, e.name)) for e in result.numbers]
    return Table("What these are", ("quantity", "what it is", "name"), tuple((q.plain, q.what, n) for n, q in meant))


def state_table(state: RigState) -> Table:
    """Return the rig as found, from which terms, and whether they agree on it."""
    agree = "agree" if state.agreement_p_value >= DiffLimits().chance else "do not agree"
    chi2 = f" (they {agree}: χ² {state.agreement_chi2:.3g} of {state.agreement_dof})" if state.agreement_dof else ""
    rows = tuple(
        (quantity("rig", e.name).plain, number(e.value, e.sigma), spread(e.sigma), e.unit, _before(e))
        for e in state.estimates
    )
    columns = ("quantity", "value", "sigma", "unit", "rig file")
    return Table(f"The rig as found from {', '.join(state.terms)}{chi2}", columns, rows, frozenset({1, 2}))


def captures_sentence(result: FitResult) -> str:
    """Return what a fit used, as far as it is known; empty for a term that was not fitted."""
    if result.unfitted or result.status is FitStatus.IMPORTED:
        return ""
    used = result.captures
    if used is None:
        return (
            f"What the {result.name} fit used and left out is not known: older profiles, and those that a check has "
            "updated, do not say so."
        )
    warm = "" if used.temperature_C is None else f" at {_span(used.temperature_C)} °C"
    times = " to ".join(dict.fromkeys(used.completed_at))
    effort = "" if result.effort in ("full", None) else f" Its effort was {result.effort}: a full fit may be better."
    return (
        f"The {result.name} fit used {used.frames} frames in {used.files} files, with a gain of "
        f"{_span(used.gain_dB)} dB{warm}, captured {times}.{effort}"
    )


def _span(low_high: tuple[float, float]) -> str:
    """Lowest and highest; once where they are the same."""
    return " to ".join(dict.fromkeys(f"{value:.4g}" for value in low_high))


def _before(one: Estimate) -> str:
    """What was known before the data, and whether that decides."""
    if one.prior is None:
        return "–"
    decides = ", decides" if one.by_prior else ""
    return f"{one.prior.value:.4g} ± {one.prior.sigma:.2g}{decides}"


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
