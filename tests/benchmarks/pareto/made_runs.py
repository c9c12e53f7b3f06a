"""Runs that tests make up."""

from __future__ import annotations

from tests.benchmarks.pareto.groups import Group
from tests.benchmarks.pareto.runs import Run
from udccal.tiers import Tier

DB = {Tier.preview: 25.0, Tier.fast: 31.0, Tier.balanced: 33.0, Tier.accurate: 34.0}
MS = {Tier.preview: 4.0, Tier.fast: 30.0, Tier.balanced: 80.0, Tier.accurate: 900.0}


def made(group: Group, tier: Tier, scene: str, dB: float | None = None, ms: float | None = None) -> Run:
    """A run, by default as good and as quick as its tier should be."""
    found, took = DB[tier] if dB is None else dB, MS[tier] if ms is None else ms
    return Run(group, tier, scene, "usual", 20.0, found, 2.5, 0.9, 0.1, took, 1.5 * took, 300.0)


def good_runs(scenes: tuple[str, ...] = ("a", "b")) -> list[Run]:
    """Runs of every tier on every scene, in both groups that have limits."""
    return [
        made(group, tier, f"{scene}, {group}")
        for group in (Group.nineteen, Group.fine)
        for tier in Tier
        for scene in scenes
    ]
