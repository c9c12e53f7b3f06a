"""From how wrong a description of the rig the fits still get to the right answer. Part of `make extremes`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from tests.benchmarks.extremes import backscatter, geometry, psf, wire
from tests.benchmarks.extremes.case import Outcome
from udccal.result import FitStatus

# Tried one after the other, away from 1, until one fails.
_LOWER = (0.8, 0.67, 0.5, 0.33)
_UPPER = (1.2, 1.5, 2.0, 3.0)


@dataclass(frozen=True)
class Start:
    """A fit that begins with one number of the rig's description off by a factor."""

    term: str
    what: str
    run: Callable[[float], Outcome]


@dataclass(frozen=True)
class Basin:
    """Factors from which a fit converged within its own error bars: from ``least`` to ``most``; 1 where none did."""

    start: Start
    least: float
    most: float

    @property
    def ok(self) -> bool:
        """Whether descriptions that are 20 % off will do."""
        return self.least <= _LOWER[0] and self.most >= _UPPER[0]


STARTS = (
    Start("geometry", "focal length", geometry.off_by),
    Start("wire", "stand-off in pitches", lambda factor: wire.wrong_start(factor, 1.0)),
    Start("wire", "pupil in pitches", lambda factor: wire.wrong_start(1.0, factor)),
    Start("wire", "pitch", lambda factor: wire.wrong_start(1 / factor, 1 / factor)),
    Start("psf", "pitch", lambda factor: psf.fit_from(psf.Off(pitch=factor))),
    Start("psf", "stand-off in pitches", lambda factor: psf.fit_from(psf.Off(standoff=factor))),
    Start("psf", "pupil in pitches", lambda factor: psf.fit_from(psf.Off(pupil=factor))),
    Start("backscatter", "stand-off", lambda factor: backscatter.wrong_start(distance=factor)),
    Start("backscatter", "pupil (aperture of the lens)", lambda factor: backscatter.wrong_start(lens=factor)),
)


def basin(start: Start) -> Basin:
    """Try factors away from 1 until one fails, both ways."""
    return Basin(start, _farthest(start, _LOWER), _farthest(start, _UPPER))


def _farthest(start: Start, factors: tuple[float, ...]) -> float:
    reached = 1.0
    for factor in factors:
        found = start.run(factor)
        if not (found.ok and found.status is FitStatus.CONVERGED):
            break
        reached = factor
    return reached


def table(rows: list[Basin]) -> str:
    """Markdown."""
    head = ["| term | off in the description | converges from | to | |", "| --- | --- | ---: | ---: | --- |"]
    body = [
        f"| {r.start.term} | {r.start.what} | × {r.least:g}{'' if r.least > _LOWER[-1] else ' and less'} | "
        f"× {r.most:g}{'' if r.most < _UPPER[-1] else ' and more'} | {'ok' if r.ok else '**missed**'} |"
        for r in rows
    ]
    return "\n".join(head + body)
