"""A row per extreme of rig or frame: the tier that overshoots a step of light most, if all give finite pictures."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from tests.benchmarks.rows import Row, at_most
from tests.scenes.extremes import MOST_OVERSHOOT, extremes, overshoot_of_a_pixel
from udccal.tiers import Tier


@dataclass(frozen=True)
class Edge:
    """Overshoot of a tier under an extreme, as a part of the step; not a number where a picture is not finite."""

    extreme: str
    tier: Tier
    overshoot: float


def edges_of() -> list[Edge]:
    """Every extreme at every tier, on the toy rig."""
    named: list[tuple[str, Callable[[Tier], float]]] = [
        (each.name, lambda tier, own=each: own.overshoot(own.restorer(tier))) for each in extremes()
    ]
    named.append(("a crop of one pixel, deblurred", overshoot_of_a_pixel))
    return [Edge(name, tier, found(tier)) for name, found in named for tier in Tier]


def edge_rows(edges: Iterable[Edge]) -> list[Row]:
    """The worst tier of each extreme; the worst of all is a picture that is not finite."""
    edges, rows = list(edges), []
    for name in dict.fromkeys(edge.extreme for edge in edges):
        worst = max(
            (edge for edge in edges if edge.extreme == name),
            key=lambda edge: (edge.overshoot != edge.overshoot, edge.overshoot),
        )
        said = f"overshoot, {name} ({worst.tier})"
        rows.append(at_most(said, 100 * worst.overshoot, 100 * MOST_OVERSHOOT, "%"))
    return rows
