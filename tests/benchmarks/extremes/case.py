"""One extreme input to a fit, and what must come of it: a result within its own error bars, or a status with advice."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from udccal.result import FitResult, FitStatus

# Of the errors in units of the stated sigma: the largest of a handful of numbers, where each is normal.
WORST_Z = 4.5
# float32 may differ from float64 by this much of a sigma; "" stands where the fit insists on float64.
MOST_SINGLE = 0.1


@dataclass(frozen=True)
class Outcome:
    """Result of a fit of an extreme input.

    Attributes:
        status: how it ended.
        z: errors of the numbers that the case is about, in units of their sigma; empty where the fit gave none.
        finite: whether every number that it gave is finite.
        advice: what a person should do, in addition to the status.
    """

    status: FitStatus
    z: Float[np.ndarray, " n"]
    finite: bool
    advice: str

    @property
    def ok(self) -> bool:
        """A result within its error bars, or a named status that says what to do; a result that none judged is not."""
        if not self.finite:
            return False
        if self.z.size and self.status in (FitStatus.CONVERGED, FitStatus.ABSENT):
            return float(np.abs(self.z).max()) <= WORST_Z
        return bool(self.advice) and self.status is not FitStatus.CONVERGED


@dataclass(frozen=True)
class Case:
    """An extreme input to one term's fit; ``run`` makes the data, seeded, and fits them."""

    term: str
    name: str
    run: Callable[[], Outcome]


def outcome(result: FitResult, z: Float[np.ndarray, " n"] | None = None) -> Outcome:
    """Of a fit result and the errors of what it gave, in sigma."""
    import jax

    leaves = [np.asarray(leaf, dtype=np.float64) for leaf in jax.tree.leaves(result.term) if np.size(leaf)]
    numbers = [*leaves, np.array([v for e in result.estimates for v in (e.value, e.sigma)]), np.asarray(result.cov)]
    finite = all(bool(np.isfinite(part).all()) for part in numbers)
    return Outcome(result.status, np.zeros(0) if z is None else np.asarray(z), finite, " ".join(result.notes))


def table(rows: list[tuple[Case, Outcome, float]]) -> str:
    """The outcomes as a Markdown table, with the seconds each took."""
    head = ["| term | extreme | status | worst error | |", "| --- | --- | --- | ---: | --- |"]
    body = [
        f"| {case.term} | {case.name} | {found.status.name} | "
        f"{f'{np.abs(found.z).max():.1f} σ' if found.z.size else '–'} | {'ok' if found.ok else '**missed**'} |"
        for case, found, _ in rows
    ]
    return "\n".join(head + body)
