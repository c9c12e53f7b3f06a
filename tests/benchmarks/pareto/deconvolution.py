"""The work `deconv` of `make peers` as rows: pictures and kernels, nothing else told, through ``deblur`` at every tier.

Beside the tiers run what people do at least, plain Wiener tiles, and SCICO where its environment is there. Times are
what the scripts print, the median of some calls with kernels and picture in memory; all run one after another.
"""

from __future__ import annotations

import itertools
import math
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from tests.benchmarks.peers.lines import Line
from tests.benchmarks.peers.run import SCICO, Peer, environment_for, python_of, run_ours, run_peer
from tests.benchmarks.rows import Row, at_least, at_most
from udccal.tiers import Tier

SIZES: Final = ((640, 360), (1920, 1080))
TIERS: Final = tuple(tier for tier in Tier if tier is not Tier.preview)
_SMALL, _LARGE = SIZES
# What plain Wiener tiles reach on the small picture at the best of the floor's strengths.
_FLOOR_DB, _LARGE_DB, _BEST_DB = 25.7, 30.5, 33.0
# Of SCICO's time, in which the best tier has to be done.
_PART: Final = 1 / 5
# numpy and scipy are all that it needs.
_FLOOR: Final = Peer("deconv", "classic", "deconv_tiles.py wiener")


@dataclass(frozen=True)
class Deconvolved:
    """One way on one picture: dB of linear light without a border of 32 px, and seconds."""

    dB: float
    seconds: float

    @classmethod
    def of(cls, lines: Iterable[Line]) -> Deconvolved:
        """From what a script printed; of one that failed, both are not numbers."""
        line = next(iter(lines))
        dB, seconds = line.number("psnr"), line.number("seconds")
        return cls(math.nan if dB is None else dB, math.nan if seconds is None else seconds)


@dataclass(frozen=True)
class Deconvolutions:
    """Ours by size and tier; on the large picture also the floor, and SCICO, or None where it did not run."""

    ours: Mapping[tuple[tuple[int, int], Tier], Deconvolved]
    floor: Deconvolved
    scico: Deconvolved | None


def deconvolutions_of(peers: Path, environments: Path) -> Deconvolutions:
    """Run the scripts, one after another.

    Args:
        peers: folder of works.py.
        environments: where setup.sh has put the peers' environments; they need not be there.
    """
    environment = environment_for(environments)
    ours = {
        (size, tier): Deconvolved.of(run_ours("deconv", _script(size, tier), peers, environment))
        for size, tier in itertools.product(SIZES, TIERS)
    }
    floor = Deconvolved.of(run_peer(_FLOOR, sys.executable, peers, environment))
    python = python_of(SCICO.environment, environments)
    scico = Deconvolved.of(run_peer(SCICO, python, peers, environment)) if Path(python).is_file() else None
    return Deconvolutions(ours, floor, scico)


def deconv_rows(found: Deconvolutions) -> list[Row]:
    """Every tier on the small picture, the default one on the large one, and the best within a part of SCICO's time."""
    rows = [at_least(f"deconv 640 x 360, {tier}", found.ours[_SMALL, tier].dB, _FLOOR_DB, "dB") for tier in TIERS]
    default = found.ours[_LARGE, Tier.balanced]
    rows.append(at_least("deconv 1920 x 1080, deblur", default.dB, _LARGE_DB, "dB"))
    ratio = default.seconds / found.floor.seconds
    rows.append(at_most("deconv 1920 x 1080, time of deblur over that of plain Wiener tiles", ratio, 1.0, ""))
    if found.scico is None:
        name, limit_s = "a tier in any time, as SCICO was not run", math.inf
    else:
        name, limit_s = f"a tier in a fifth of SCICO's {found.scico.seconds:.3g} s", _PART * found.scico.seconds
    within = [found.ours[_LARGE, tier] for tier in TIERS]
    best = max((one.dB for one in within if one.seconds <= limit_s), default=math.nan)
    return [*rows, at_least(f"deconv 1920 x 1080, {name}", best, _BEST_DB, "dB")]


def deconv_table(found: Deconvolutions) -> str:
    """As Markdown: dB and seconds of everything that ran."""
    lines = ["| deconv | 640 x 360, dB | s | 1920 x 1080, dB | s |", "| --- | ---: | ---: | ---: | ---: |"]
    for tier in TIERS:
        small, large = (found.ours[size, tier] for size in SIZES)
        lines.append(f"| `deblur`, {tier} | {_cells(small)} | {_cells(large)} |")
    lines.append(f"| plain Wiener tiles | {_FLOOR_DB:.2f} | | {_cells(found.floor)} |")
    scico = "not run | " if found.scico is None else _cells(found.scico)
    return "\n".join([*lines, f"| SCICO, space-varying, TV | | | {scico} |"])


def _cells(one: Deconvolved) -> str:
    return f"{one.dB:.2f} | {one.seconds:.3g}"


def _script(size: tuple[int, int], tier: Tier) -> str:
    """The large picture is the work as it is, whose input all scripts share."""
    return f"ours_deconv --tier {tier}" + ("" if size == _LARGE else f" --size {size[0]} {size[1]}")
