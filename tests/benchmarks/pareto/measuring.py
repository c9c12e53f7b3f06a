"""The run itself: frames are taken, every tier restores them, and what it gives is judged."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from tests.benchmarks.full_blur import BLUR_GRID, build_full_blur
from tests.benchmarks.pareto.clear_camera import without_panel
from tests.benchmarks.pareto.deconvolution import deconv_rows, deconvolutions_of
from tests.benchmarks.pareto.edges import edge_rows, edges_of
from tests.benchmarks.pareto.exponents import growth_rows, growths_of
from tests.benchmarks.pareto.fine_scenes import fine_scenes
from tests.benchmarks.pareto.groups import COMPARED, Case, Group, cases_of
from tests.benchmarks.pareto.instead import peer_rows, peers_of
from tests.benchmarks.pareto.judging import gain_rows, loss_rows, order_rows, time_rows
from tests.benchmarks.pareto.others import others_of
from tests.benchmarks.pareto.plans import choice_rows, error_rows, plans_of
from tests.benchmarks.pareto.precision import losses_of
from tests.benchmarks.pareto.restoring import Setup, TierProcess
from tests.benchmarks.pareto.runs import Clear, Run, Sight, sight_of
from tests.benchmarks.pareto.sheets import Shown, is_shown, shown_part, write_sheet
from tests.benchmarks.pareto.starts import start_rows, starts_of
from tests.benchmarks.pareto.tables import Measured
from tests.benchmarks.pictures import PictureBench
from tests.benchmarks.scenes import shared_scenes
from udccal.profiles.profile import Profile
from udccal.restoration.metrics import encode_srgb, psnr
from udccal.restoration.plan import PlanOptions
from udccal.restoration.runtime import Restorer
from udccal.simulation.truth import RigTruth
from udccal.tiers import Tier

# Every n-th of the nineteen is restored by others too.
_PEERS_EVERY = 5
# Of those, as many by libraries that need minutes for a frame.
_OTHERS_SCENES = 2
# In these nothing clips.
_PRECISION_SCENES = ("Carrots", "kodim05", "kodim15", "mosaic 1")


@dataclass(frozen=True)
class PeerFolders:
    """Where others' programs are.

    Attributes:
        works: folder of works.py and of the peers' scripts.
        environments: of the peers' environments, each of which may be absent.
    """

    works: Path
    environments: Path


@dataclass(frozen=True)
class Seen:
    """What the camera took: a sight per picture, and the cases, of which several may be one picture."""

    bench: PictureBench
    cases: list[Case]
    sights: dict[tuple[str, str], Sight]
    clear: list[Clear]

    @property
    def usual(self) -> list[Sight]:
        """Sights of the compared groups, the nineteen first."""
        return [sight for sight in self.sights.values() if sight.case.group in COMPARED]


def seen_by(truth: RigTruth, profile: Profile, data: Path, every: int) -> Seen:
    """Take the frame of every case, at the room light that ``make accuracy`` sets for the nineteen.

    Args:
        truth: the simulated rig.
        profile: the rig as measured, which gives the view.
        data: folder of the shared pictures.
        every: keeps each n-th scene for a quicker look.
    """
    captures = truth.description.captures
    blur = build_full_blur(truth, *BLUR_GRID, captures.psf_region_rows + 1, captures.psf_region_columns + 1)
    bench = PictureBench(truth, blur, Restorer.from_profile(profile, Tier.preview))
    nineteen, fine = bench.shots(shared_scenes(data, every)), bench.shots(fine_scenes(data, truth, every))
    light = bench.matched_room_light(nineteen)
    cases = cases_of(nineteen, fine)
    first = {case.key: case for case in reversed(cases)}
    sights = {key: sight_of(bench, first[key], light) for key in dict.fromkeys(case.key for case in cases)}
    compared = [(Group.nineteen, shot) for shot in nineteen] + [(Group.fine, shot) for shot in fine]
    clear = [
        Clear(group, shot.name, psnr(without_panel(bench, shot, light), encode_srgb(shot.ideal)))
        for group, shot in compared
    ]
    return Seen(bench, cases, sights, clear)


def kept_of(folder: Path) -> Path:
    """Where, after ``measured``, all is kept that any tier's defaults need."""
    return folder / Tier.accurate


def measured(
    name: str, profile: Profile, seen: Seen, out: Path, folder: Path, peers: PeerFolders, say: Callable[[str], None]
) -> Measured:
    """Measure everything but what choices trade.

    Args:
        name: the profile's path or name, by which other processes read it.
        profile: the same, read.
        seen: what the camera took.
        out: folder for the sheets of pictures.
        folder: for a folder of prepared arrays per tier, empty at first: each tier prepares all that it needs.
        peers: where others are.
        say: tells a person how far it is.
    """
    runs, ready_s = list[Run](), dict[Tier, float]()
    for tier in Tier:
        setup = Setup(name, tier, PlanOptions(), folder / tier)
        own, ready_s[tier] = _runs_of(setup, seen, out / f"{tier}.png")
        runs += own
        say(f"{tier} has restored them")
    keep = kept_of(folder)
    starts = starts_of(name, seen.usual[0].taken)
    say("programs have started")
    plans = plans_of(profile, seen.usual, keep)
    say("plans are made")
    some = [sight for sight in seen.usual if sight.case.shot.name in _PRECISION_SCENES] or seen.usual[:1]
    losses = losses_of(name, some, keep)
    say("tables are rounded")
    growths = growths_of(name, seen.usual[0].taken, keep)
    say("growth is measured")
    compared = [sight for sight in seen.usual if sight.case.group is Group.nineteen][::_PEERS_EVERY]
    fast, few = Restorer.from_profile(profile, Tier.fast, keep=keep), compared[:_OTHERS_SCENES]
    instead, others = peers_of(fast, compared), others_of(fast, few, peers.environments)
    say("others have restored them")
    deconvolutions = deconvolutions_of(peers.works, peers.environments)
    say("given kernels are deconvolved")
    edges = edges_of()
    say("extremes are restored")
    camera = profile.rig.camera
    rows = [
        *time_rows(runs, camera.rows * camera.columns),
        *order_rows(runs),
        *gain_rows(runs),
        *loss_rows(runs),
        *choice_rows(plans, runs),
        *error_rows(plans, runs),
        *start_rows(starts),
        *growth_rows(growths),
        *peer_rows(instead, runs, [sight.case.shot.name for sight in compared]),
        *peer_rows(others, runs, [sight.case.shot.name for sight in few]),
        *deconv_rows(deconvolutions),
        *edge_rows(edges),
    ]
    return Measured(runs, seen.clear, ready_s, plans, losses, [*instead, *others], deconvolutions, rows)


def _runs_of(setup: Setup, seen: Seen, sheet: Path) -> tuple[list[Run], float]:
    """One tier on every picture, and the seconds to prepare it; also writes its sheet of pictures.

    One process prepares, another restores: what preparation takes is not part of a frame's memory.
    """
    found, shown, first = dict[tuple[str, str], Run](), list[Shown](), seen.usual[0].taken
    with TierProcess(setup) as process:
        ready_s = process.ready_s(first)
    with TierProcess(setup) as process:
        process.ready_s(first)
        for key, sight in seen.sights.items():
            restored = process.restored(sight.taken)
            picture = sight.after(restored.linear)
            found[key] = sight.run(setup.tier, picture, restored.cost)
            if is_shown(sight):
                shot, grey = sight.case.shot, sight.case.conditions.grey
                before = seen.bench.before(shot, sight.room_light, grey)
                title = ", ".join(name for name in key if name)
                shown.append(shown_part(f"{title}: before | {setup.tier} | truth", before, picture, sight.truth))
    write_sheet(shown, sheet)
    return [replace(found[case.key], group=case.group) for case in seen.cases], ready_s
