"""How far the kernel reaches: the smallest window outside of which pictures held out show none of its light.

Along rows and along columns by itself, since a kernel of pixel rows is a cross. Every window of a ladder is tried:
inside it the kernel is the model's, outside there is none but an even background. Its criterion is minus twice the
logarithm of the likelihood of the samples held out, robust as in ``psf.held_out``, and one logarithm of their number
for every step up the ladder (Schwarz, "Estimating the dimension of a model", 1978): light that is there pays for the
step many times, light that only the model sees does not.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, final

import numpy as np
from jaxtyping import Bool, Int

from udccal.fitting.psf.held_out import Judged
from udccal.fitting.psf.weights import huber
from udccal.result import Candidate

_LEAST_PX: Final = 4
_STEP: Final = np.sqrt(2.0)


@final
@dataclass(frozen=True)
class Support:
    """What was chosen.

    Attributes:
        half_px: (rows, columns) to either side of the source.
        seen_px: (rows, columns) to either side that the pictures held.
        candidates: every window tried, both axes; criteria in units of the log-likelihood, over that of the best.
    """

    half_px: tuple[int, int]
    seen_px: tuple[int, int]
    candidates: tuple[Candidate, ...]

    @property
    def open_ended(self) -> tuple[bool, bool]:
        """Along (rows, columns), whether light was seen up to the border of what the pictures held."""
        rows, columns = (chosen >= seen for chosen, seen in zip(self.half_px, self.seen_px, strict=True))
        return rows, columns


def choose_support(judged: Judged) -> Support:
    """The window of least criterion, from samples that the model has not seen in windows about each source."""
    rows, columns = judged.residual.shape[1:]
    down, across = np.abs(np.arange(rows) - rows // 2), np.abs(np.arange(columns) - columns // 2)
    by_rows = _along(judged, "rows", np.broadcast_to(down[:, None], (rows, columns)))
    by_columns = _along(judged, "columns", np.broadcast_to(across, (rows, columns)))
    return Support(
        half_px=(by_rows.half_px, by_columns.half_px),
        seen_px=(rows // 2, columns // 2),
        candidates=(*by_rows.candidates, *by_columns.candidates),
    )


def ladder(largest_px: int) -> tuple[int, ...]:
    """Windows to try, to either side: each half as large again as the one before the last, up to the largest."""
    count = int(np.ceil(np.log(max(largest_px / _LEAST_PX, 1.0)) / np.log(_STEP)))
    steps = np.round(_LEAST_PX * _STEP ** np.arange(count)).astype(int)
    return (*(int(step) for step in steps if step < largest_px), largest_px)


@final
@dataclass(frozen=True)
class _Axis:
    half_px: int
    candidates: tuple[Candidate, ...]


def _along(judged: Judged, name: str, distance: Int[np.ndarray, "rows columns"]) -> _Axis:
    halves = ladder(int(distance.max()))
    penalty = np.log(max(int(judged.known.sum()), 1))
    criteria = np.array([_loss(judged, distance <= half) + step * penalty for step, half in enumerate(halves)])
    best = int(np.argmin(criteria))
    candidates = tuple(
        Candidate(f"{name}: light within {half} px", step, float(value - criteria[best]), step == best)
        for step, (half, value) in enumerate(zip(halves, criteria, strict=True))
    )
    return _Axis(halves[best], candidates)


def _loss(judged: Judged, inside: Bool[np.ndarray, "rows columns"]) -> float:
    """Of all samples, with the kernel's light inside alone and each picture's background found anew."""
    weight = np.where(judged.known, 1.0 / judged.total, 0.0)
    error = judged.residual + judged.light * ~inside
    background = (weight * error).sum(axis=(1, 2)) / np.maximum(weight.sum(axis=(1, 2)), 1e-300)
    size = np.abs(error - background[:, None, None]) * np.sqrt(weight)
    return float(huber(size).sum())
