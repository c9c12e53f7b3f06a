"""The page of a comparison of two profiles: what to do, the movement, and each term with its maps."""

from __future__ import annotations

from udccal.comparison.diff import ProfileDiff
from udccal.comparison.maps import DifferenceMaps
from udccal.comparison.term_diff import TermDiff, Verdict
from udccal.reports.diff_figures import rays_figure, wire_difference_figure
from udccal.reports.diff_tables import (
    effects_table,
    estimates_diff_table,
    finding,
    movement_sentence,
    movement_table,
    notes,
)
from udccal.reports.figures import embedded_png
from udccal.reports.page import Advice, DiffPage, DiffSection, Fact, Illustration

_HEADLINES: dict[Verdict, str] = {
    "same": "The profiles agree.",
    "not compared": "Not all of the profiles could be compared.",
    "changed, harmless": "The profiles differ, but nobody would see it.",
    "changed": "The profiles differ by more than is harmless.",
}


def diff_page(found: ProfileDiff, maps: DifferenceMaps) -> DiffPage:
    """Build the page of one comparison."""
    pictures = {
        "geometry": Illustration(
            embedded_png(rays_figure(maps.rays_px, maps.wire.shape)),
            "How far a ray of the panel's frame is imaged from where A images it. Arrows: direction.",
            "difference of the rays",
        ),
        "wire": Illustration(
            embedded_png(wire_difference_figure(maps.wire)),
            "B's wire map over A's, less 1.",
            "difference of the wire maps",
        ),
    }
    return DiffPage(
        title=f"Two profiles of {found.rig}",
        advice=Advice(_HEADLINES[found.verdict], found.verdict.split()[-1], (found.advice,)),
        facts=(
            Fact("A made", found.a.created_at),
            Fact("B made", found.b.created_at),
            Fact("lost by restoring with the other profile", f"{found.picture_dB_lost:.2f} dB"),
        ),
        movement_sentence=movement_sentence(found),
        movement=movement_table(found.movement),
        sections=tuple(_section(one, pictures.get(one.term)) for one in found.terms),
    )


def _section(one: TermDiff, picture: Illustration | None) -> DiffSection:
    return DiffSection(
        term=one.term,
        verdict=one.verdict,
        finding=finding(one),
        effects=effects_table(one),
        illustrations=() if picture is None else (picture,),
        estimates=estimates_diff_table(one),
        notes=notes(one),
    )
