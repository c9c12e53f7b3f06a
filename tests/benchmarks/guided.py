"""`make guided`: a rig calibrated by a hand that misses its aims, against one whose captures are commanded exactly.

    python -m tests.benchmarks.guided [--rig RIG] [--specimens N] [--out DIR]

The rigs are the first specimens of the accuracy table. Sigmas that come from how far a specimen's data disagree scatter
by chance: of several specimens, the median of each quantity's ratio counts, and the worst error. The simulated hand
holds the LED up to 20 px and boards up to 3 degrees away from where they are wanted, and goes on wherever the guide
says that all is in order. Both sessions are fitted. Captures, prompts and profiles in DIR are kept, and a second run
goes on from there: a step that a stopped run left is captured again, and its prompts count twice. Writes DIR/RIG.json
and the rig's table of docs/cli.md; exits with 1 where a number misses its limit.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

import numpy as np

from tests.benchmarks.commit import this_commit
from tests.benchmarks.draws import FULL, REDUCED, Draw
from tests.benchmarks.readme_tables import has_table, put_table
from tests.benchmarks.rows import Row, at_most, table, write_json
from tests.benchmarks.terms import term_rows
from tests.guide.scripted import Scripted
from udccal.benches.bench import simulated_bench
from udccal.benches.capture import capture
from udccal.cli.jobs.fit import fit_to_profile
from udccal.cli.output import Output
from udccal.fitting.psf.fit import NOISE_SIGMA
from udccal.guide.capture import lead_capture
from udccal.guide.events import Answer
from udccal.io.atomic import write_atomically
from udccal.profiles.profile import Profile
from udccal.profiles.store import read_profile
from udccal.result import FitResult
from udccal.sessions.schema import TermName
from udccal.sessions.writer import SessionWriter
from udccal.simulation.hand import Hand
from udccal.simulation.world import SimulatedWorld

_PAGE = Path(__file__).resolve().parents[2] / "docs" / "cli.md"
_MOST_PROMPTS, _MOST_SIGMA = 40, 1.10
_AIMED: tuple[TermName, ...] = ("geometry", "psf")


@dataclass(frozen=True)
class Calibrated:
    """A profile, and how often a person was asked for it."""

    profile: Profile
    prompts: int
    commit: str


@dataclass(frozen=True)
class Pair:
    """A specimen, calibrated by exact commands and by hand."""

    draw: Draw
    commanded: Calibrated
    guided: Calibrated

    @classmethod
    def of(cls, draw: Draw, out: Path) -> Pair:
        """Calibrate both ways, or take what is there."""
        names = ("commanded", "guided")
        return cls(draw, *(calibrated(draw, out / f"{draw}-{name}", name == "guided") for name in names))

    def errors(self) -> list[Row]:
        """What is wrong with the guided profile's terms that are aimed."""
        rows = term_rows(self.guided.profile, self.draw.truth)
        return [row for row in rows if row.name.startswith(("psf", "projection", "tilt"))]


def calibrated(draw: Draw, folder: Path, by_hand: bool) -> Calibrated:
    """Capture and fit a specimen, or take what the folder holds from before."""
    session, profile, commit, asked = (folder / name for name in ("session", "profile", "commit.txt", "prompts.txt"))
    if not commit.exists():
        world = SimulatedWorld(draw.truth, seed=draw.seed)
        if by_hand:
            _lead(world, session, asked)
        else:
            with simulated_bench(world) as bench:
                capture(session, bench)
        fit_to_profile(Output(), session, profile)
        write_atomically(commit, this_commit().encode())
    prompts = int(asked.read_text(encoding="utf-8")) if by_hand else 0
    return Calibrated(read_profile(profile), prompts, commit.read_text(encoding="utf-8").strip())


class _Counted(Scripted):
    """A willing person whose prompts are counted in a file, on top of those of earlier runs."""

    def __init__(self, file: Path) -> None:
        super().__init__()
        self._file, self._before = file, int(file.read_text(encoding="utf-8")) if file.exists() else 0

    def answer(self, offered: tuple[Answer, ...], wait_s: float) -> Answer | None:
        before, answer = self.prompts, super().answer(offered, wait_s)
        if self.prompts > before:
            write_atomically(self._file, str(self._before + self.prompts).encode())
        return answer


def _lead(world: SimulatedWorld, session: Path, asked: Path) -> None:
    """Lead a willing person, whose hand is inexact, through every step that the session lacks."""
    person = _Counted(asked)
    with simulated_bench(world) as bench:
        held = replace(bench, stage=Hand(world))
        with SessionWriter.create_or_resume(session, bench.rig, bench.camera.identity, now=bench.now) as writer:
            lead_capture(writer, held, person, get_args(TermName))
    assert person.done.complete, person.done.sentence


def judged(pairs: list[Pair]) -> list[Row]:
    """The person's prompts, what sigmas have become, and the errors of the terms that are aimed."""
    told = [max(same, key=lambda row: row.value) for same in zip(*(pair.errors() for pair in pairs), strict=True)]
    return prompts_and_sigmas(pairs) + [replace(row, name=f"guided: {row.name}") for row in told]


def prompts_and_sigmas(pairs: list[Pair]) -> list[Row]:
    """The most prompts of a specimen, and sigmas of the guided captures over those of the commanded ones."""
    rows = [at_most("prompts of the guided capture", max(pair.guided.prompts for pair in pairs), _MOST_PROMPTS, "")]
    for term in _AIMED:
        each = [sigma_ratios(*(getattr(one.profile, term) for one in (p.commanded, p.guided))) for p in pairs]
        names = set.intersection(*(set(ratios) for ratios in each))
        ratios = {name: float(np.median([one[name] for one in each])) for name in sorted(names)}
        worst, what = max(ratios, key=lambda name: ratios[name]), f"{term}: sigma, guided over commanded"
        median = float(np.median(list(ratios.values())))
        rows.append(at_most(f"{what}, median of {len(ratios)}", median, _MOST_SIGMA, ""))
        rows.append(at_most(f"{what}, worst ({worst})", ratios[worst], _MOST_SIGMA, ""))
    by_noise = [noise_ratios(pair.commanded.profile.psf, pair.guided.profile.psf) for pair in pairs]
    ratios = {name: float(np.median([one[name] for one in by_noise])) for name in by_noise[0]}
    worst = max(ratios, key=lambda name: ratios[name])
    what = f"psf: sigma by noise alone, guided over commanded, worst of {len(ratios)} ({worst})"
    rows.append(at_most(what, ratios[worst], _MOST_SIGMA, ""))
    return rows


def sigma_ratios(commanded: FitResult, guided: FitResult) -> dict[str, float]:
    """Of every quantity that has a meaning of its own, and whose sigma the data decide."""
    one, other = ({each.name: each for each in result.numbers} for result in (commanded, guided))
    return {
        name: other[name].sigma / one[name].sigma
        for name in one
        if name in other and one[name].sigma > 0 and not one[name].by_prior
    }


def noise_ratios(one: FitResult, other: FitResult) -> dict[str, float]:
    """Of the psf's numbers: what the captures tell about them, whatever the model's deviation is found to be."""
    names = [each.name for each in one.diagnostics if each.name.startswith(NOISE_SIGMA)]
    found = {name: (one.diagnostic(name), other.diagnostic(name)) for name in names}
    return {name.removeprefix(NOISE_SIGMA): b / a for name, (a, b) in found.items() if a and b}


def main() -> int:
    """Calibrate every specimen twice and compare."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rig", choices=FULL + REDUCED, default=FULL[0])
    parser.add_argument("--specimens", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("guided"))
    options = parser.parse_args()
    pairs = [Pair.of(Draw(options.rig, number), options.out) for number in range(options.specimens)]
    rows, what = judged(pairs), f"guided {options.rig}"
    write_json(rows, options.out / f"{options.rig}.json")
    print(table(rows))
    if has_table(_PAGE, what):
        commits = [one.commit for pair in pairs for one in (pair.commanded, pair.guided)]
        put_table(_PAGE, what, f"{len(pairs)} of `{options.rig}`:\n\n{table(rows)}", commits)
    return 0 if all(row.ok for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
