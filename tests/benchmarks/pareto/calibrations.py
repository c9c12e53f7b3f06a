"""The trade in calibration: what profiles of fewer captures lose in the pictures that they restore.

    python -m tests.benchmarks.pareto.calibrations [--rig NAME] [--seed N] [--every N]

Calibrates the simulated rig's specimen ``--seed`` once for each set of captures, and restores every n-th of the
nineteen scenes. Prints the table, and puts it into docs/restoration.md where that has markers for the rig.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final, get_args

import numpy as np

import udccal
from tests.benchmarks.pareto.groups import Group
from tests.benchmarks.pareto.measuring import seen_by
from tests.benchmarks.pareto.restoring import Setup, TierProcess
from tests.benchmarks.pareto.runs import Sight
from tests.benchmarks.readme_tables import has_table, put_table
from udccal.benches.bench import simulated_bench
from udccal.planning.state import nominal_state
from udccal.planning.steps import Cost
from udccal.profiles.store import load_profile
from udccal.restoration.metrics import psnr
from udccal.restoration.plan import PlanOptions
from udccal.rig import Captures, RigDescription, load_rig
from udccal.sessions.schema import TermName
from udccal.simulation.truth import RigTruth, draw_truth
from udccal.simulation.world import SimulatedWorld
from udccal.tiers import Tier

_ROOT: Final = Path(__file__).resolve().parents[3]
# Noise of the captures; that of the frames to restore is another.
_NOISE_SEED: Final = 1


@dataclass(frozen=True)
class Fewer:
    """Captures that differ from those that the rig asks for, by the names of ``udccal.rig.Captures``."""

    changes: dict[str, int] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """As a table shows it."""
        return ", ".join(f"{name}: {count}" for name, count in self.changes.items()) or "as the rig asks"

    def of(self, rig: RigDescription) -> RigDescription:
        """Return the rig that asks for these captures; a wrong name or count is pydantic's error."""
        captures = Captures.model_validate({**rig.captures.model_dump(), **self.changes})
        return rig.model_copy(update={"captures": captures})


ALL: Final = Fewer()
# A third of the frames, and about the fewest that every fit accepts.
_THIRD: Final = {
    "flats": 6,
    "psf_shifts": 1,
    "psf_columns": 2,
    "psf_rows": 2,
    "backscatter_frames": 2,
    "board_views": 4,
}
_FEWEST: Final = {**_THIRD, "flats": 2, "noise_levels": 4, "noise_stack": 2, "psf_exposures": 3, "board_views": 3}
FEWER: Final = (
    ALL,
    Fewer({"flats": 6}),
    Fewer({"psf_shifts": 1}),
    Fewer({"psf_columns": 2, "psf_rows": 2}),
    Fewer({"psf_exposures": 3}),
    Fewer({"backscatter_frames": 2, "backscatter_pictures": 7}),
    Fewer({"board_views": 3}),
    Fewer(_THIRD),
    Fewer({**_FEWEST, "backscatter_pictures": 7}),
)


@dataclass(frozen=True)
class FromFewer:
    """What a profile of these captures gives.

    Attributes:
        cost: frames and seconds of the camera.
        dB: PSNR of each scene at ``balanced``.
        doubtful: terms whose fit did not end well.
    """

    fewer: Fewer
    cost: Cost
    dB: tuple[float, ...]
    doubtful: tuple[str, ...]


def from_fewer(truth: RigTruth, sights: Sequence[Sight], folder: Path, tried: Iterable[Fewer]) -> list[FromFewer]:
    """Calibrate a simulated rig by each set of captures, and restore some sights by the profile.

    Args:
        truth: the rig whose frames ``sights`` are.
        sights: what is restored.
        folder: an empty one for sessions and profiles.
        tried: sets of captures.
    """
    found = []
    for index, fewer in enumerate(tried):
        rig, place = fewer.of(truth.description), folder / str(index)
        with simulated_bench(SimulatedWorld(replace(truth, description=rig), seed=_NOISE_SEED)) as bench:
            session = udccal.capture(place / "session", bench)
        calibration = udccal.calibrate(session)
        calibration.write(place / "profile")
        doubtful = tuple(result.name for result in calibration.results if not result.ok)
        cost = sum((nominal_state(rig).cost(term) for term in get_args(TermName)), Cost())
        found.append(FromFewer(fewer, cost, _restored_dB(place, sights), doubtful))
    return found


def _restored_dB(place: Path, sights: Sequence[Sight]) -> tuple[float, ...]:
    with TierProcess(Setup(str(place / "profile"), Tier.balanced, PlanOptions(), place / "kept")) as process:
        return tuple(psnr(one.after(process.restored(one.taken).linear), one.truth) for one in sights)


def fewer_table(found: Sequence[FromFewer]) -> str:
    """As Markdown, the first being what the others are compared with."""
    lines = [
        "| captures | frames | camera s | dB − the first's | worst scene | doubtful terms |",
        "| --- | ---: | ---: | ---: | ---: | --- |",
    ]
    for one in found:
        lost = np.subtract(one.dB, found[0].dB)
        numbers = f"{one.cost.frames} | {one.cost.seconds:.0f} | {np.mean(lost):+.2f} | {np.min(lost):+.2f}"
        lines.append(f"| {one.fewer.name} | {numbers} | {', '.join(one.doubtful)} |")
    return "\n".join(lines)


def main() -> int:
    """Run the benchmark; it has no limits to miss."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rig", default="lg55-reduced", help="a rig whose profile ships")
    parser.add_argument("--seed", type=int, default=0, help="specimen of the simulated rig")
    parser.add_argument("--every", type=int, default=3, help="use each n-th scene only")
    options = parser.parse_args()
    data = _ROOT.parent / "shared" / "data"
    if not data.is_dir():
        print("The shared photographs (../shared/data) are absent: there is nothing to restore.", file=sys.stderr)
        return 1
    truth = draw_truth(load_rig(options.rig), options.seed)
    seen = seen_by(truth, load_profile(options.rig), data, options.every)
    sights = [sight for sight in seen.usual if sight.case.group is Group.nineteen]
    with tempfile.TemporaryDirectory() as folder:
        table = fewer_table(from_fewer(truth, sights, Path(folder), FEWER))
    print(table)
    page, marker = _ROOT / "docs" / "restoration.md", f"calibrations {options.rig}"
    if has_table(page, marker):
        put_table(page, marker, table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
