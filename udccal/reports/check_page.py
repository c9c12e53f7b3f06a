"""The table and the page of a check of a rig: what changed, what to do, and a map of the flat."""

from __future__ import annotations

import numpy as np

from udccal.drift.changes import Change
from udccal.drift.check import RigCheck, Solved, Verdict
from udccal.reports.figures import embedded_png
from udccal.reports.page import Advice, Fact, Illustration, ValidationPage, ValidationSection
from udccal.reports.tables import Table, number, spread
from udccal.reports.validation_figures import z_figure
from udccal.validation.checks import ZMap

# With the CSS class of each verdict.
_HEADLINES: dict[Verdict, tuple[str, str]] = {
    "same": ("The rig is as its profile says.", "good"),
    "changed, harmless": ("The rig changed, but nobody would see it.", "absent"),
    "changed": ("The rig changed by more than is harmless.", "bad"),
}


def changes_table(found: RigCheck) -> Table:
    """Return all changes that were looked for."""
    rows = tuple(
        (one.name, f"{number(one.value, one.sigma)} {one.unit}", spread(one.sigma), f"{one.limit:g}", _said(one))
        for one in found.changes
    )
    return Table("Since the profile was made", ("change", "value", "σ", "limit", ""), rows, frozenset({1, 2, 3}))


def check_page(found: RigCheck, solved: Solved) -> ValidationPage:
    """Build the page of one check."""
    headline, mood = _HEADLINES[found.verdict]
    z_map = ZMap(
        np.asarray(solved.pose.left / solved.pose.sigma),
        "x",
        "y",
        "The flat over the profile's wire map at the pose found, median of a part of the sensor, in sigma.",
    )
    return ValidationPage(
        title=f"A check of {found.rig}",
        advice=Advice(headline, mood, (found.advice,)),
        facts=(
            Fact("changed", ", ".join(found.changed) or ("nothing that matters" if found.explained else "not known")),
            Fact("flat over noise", f"{found.flat_over_noise:.2f}"),
        ),
        sections=(
            ValidationSection(
                term="rig",
                verdict=found.verdict,
                mood=mood,
                sentences=tuple(one.what for one in found.changes),
                checks=changes_table(found),
                illustrations=(Illustration(embedded_png(z_figure(z_map)), z_map.caption, "map of the flat"),),
            ),
        ),
    )


def _said(change: Change) -> str:
    if not change.significant:
        return "not seen"
    return "matters" if change.harmful else "harmless"
