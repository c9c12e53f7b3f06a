"""The demonstration: captures, fits and restores on a simulated rig, and compares each result with the truth."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from udccal.benches.bench import simulated_bench, simulated_rig
from udccal.benches.photograph import capture_photograph
from udccal.calibration import ORDER, Foundation, fit_foundation
from udccal.cli.jobs.capture import Wanted, capture_watched
from udccal.cli.jobs.fit import UNSEEN_PICTURE, run_fits, show_status, store_profile
from udccal.cli.output import Output, StageTime
from udccal.compilation import compilation_clock, keep_compilations
from udccal.displays.pictures import face_picture
from udccal.effort import QUICK
from udccal.fitting.psf.fit import nominal_psf
from udccal.io.links import make_folder
from udccal.io.photograph import read_photograph
from udccal.io.png import write_png16, write_rgb8
from udccal.kernels import kernel_size, kernels_at
from udccal.profiles.store import check_replaceable
from udccal.reports.page import write_page
from udccal.reports.pictures import PictureComparison, Score, compare_pictures
from udccal.reports.report import calibration_page, gather, scene_table
from udccal.reports.tables import Table
from udccal.reports.truth import TruthRow, truth_table
from udccal.restoration.plan import PlanOptions
from udccal.restoration.prepared import prepared_folder
from udccal.restoration.runtime import Restorer
from udccal.restoration.sinks import write_picture
from udccal.restoration.tone import Tone, display_exposure
from udccal.rig import RigDescription, load_rig
from udccal.sessions.schema import TermName
from udccal.sessions.store import Session
from udccal.simulation.world import SimulatedWorld

# The other fits need these terms.
_EARLY: tuple[TermName, ...] = ("noise", "geometry", "wire")
# Evening light in the room: the panel's own light is then as disturbing as it gets in practice.
_ROOM_LIGHT = 0.25
# A coarser grid of kernels than by default: quicker to compute.
_PLAN = PlanOptions(grid_rows=4, grid_columns=6)
# The part of the shipped photograph that holds the head and has the wide shape of the view.
_CROP_TOP, _CROP_SHAPE = 18, 9 / 16


@dataclass(frozen=True)
class DemoSummary:
    """Result of ``demo``."""

    rig: str
    seed: int
    report: Path
    terms: tuple[TruthRow, ...]
    before: Score
    after: Score
    times: tuple[StageTime, ...]
    seconds: float
    compilation_s: float


def demonstrate(output: Output, rig_name: str, out: Path, seed: int) -> None:
    """Run the demonstration.

    Args:
        output: shows stages and the summary.
        rig_name: name or folder of the rig.
        out: folder that receives session, profile, pictures and report.
        seed: chooses the specimen of the rig, and its noise.

    Raises:
        UdccalError: when capture, fit or restoration fails.
    """
    start = time.perf_counter()
    keep_compilations()
    clock = compilation_clock()
    rig = load_rig(rig_name)
    check_replaceable(out / "profile")
    with output.stage("simulated rig"):
        world = simulated_rig(rig, seed)
    panel_picture = face_picture(UNSEEN_PICTURE, rig.panel.columns, rig.panel.rows)
    with ThreadPoolExecutor(1) as pool, simulated_bench(world) as bench:
        # In parallel with the captures: first what only the simulated world needs, then the fits of complete terms, at
        # last the data of the report.
        blur = pool.submit(lambda: world.light.blur)
        backscatterer = pool.submit(lambda: world.light.backscatterer)
        capture_watched(output, bench, Wanted(out / "session", _EARLY[:1]))
        with output.stage("blur of the simulated panel"):
            blur.result()  # Boards are seen through it: two threads would compute it twice.
        capture_watched(output, bench, Wanted(out / "session", _EARLY[1:]))
        with output.stage("backscatter of the simulated panel"):
            backscatterer.result()
        foundation = pool.submit(fit_foundation, Session.open(out / "session"), effort=QUICK)
        pool.submit(lambda: _prepare_kernels(rig, foundation.result()))
        capture_watched(output, bench, Wanted(out / "session", [term for term in ORDER if term not in _EARLY]))
        session = Session.open(out / "session")
        with output.stage("fits of noise, geometry and wire"):
            first = foundation.result()
        calibration = run_fits(output, session, QUICK, first)
        show_status(output, calibration)
        gathered = pool.submit(gather, session, calibration, panel_picture, world.light)
        store_profile(output, calibration, out / "profile")
        scene = _restore_portrait(output, world, panel_picture, out)
    with output.stage("report"):
        evidence = gathered.result()
        report = out / "report.html"
        write_page(report, calibration_page(session, evidence, scene))
    for warning in calibration.warnings:
        output.say(warning)
    output.table(truth_table(evidence.rows))
    output.table(scene_table(scene))
    seconds = time.perf_counter() - start
    output.table(_times_table(output.times, seconds, clock.seconds))
    output.say(f"Report: {report}")
    output.result(
        DemoSummary(
            rig.name,
            seed,
            report,
            evidence.rows,
            scene.score_before,
            scene.score_after,
            tuple(output.times),
            seconds,
            clock.seconds,
        )
    )


def _prepare_kernels(rig: RigDescription, foundation: Foundation) -> None:
    """Compile the psf's kernel while the fits leave a core free; profile, report and restorer need it."""
    start = nominal_psf(rig, foundation.geometry.term, foundation.wire.term)
    kernels_at(start, np.asarray(start.centre_px)[None], *kernel_size(rig))


def portrait() -> Float[np.ndarray, "rows columns 3"]:
    """Return the photograph that ships with udccal, cropped to a wide shape, in linear light."""
    path = Path(str(resources.files("udccal") / "data" / "portrait.jpg"))
    photograph = read_photograph(path)
    height = int(photograph.shape[1] * _CROP_SHAPE)
    return photograph[_CROP_TOP : _CROP_TOP + height]


def _restore_portrait(
    output: Output, world: SimulatedWorld, panel_picture: UInt8[np.ndarray, "panel_rows panel_columns 3"], out: Path
) -> PictureComparison:
    """Capture the photograph and restore it with the stored profile; write the frames and pictures."""
    with output.stage("restorer"):
        restorer = Restorer.load(out / "profile", options=_PLAN, keep=prepared_folder())
    with output.stage("photograph through the rig"):
        scene = capture_photograph(world, _ROOM_LIGHT * portrait(), restorer.view, panel_picture)
    with output.stage("restoration"):
        after = restorer.restore(scene.mosaic, scene.exposure_s, panel_picture)
        before = restorer.before(scene.mosaic, scene.exposure_s)
    folder = out / "portrait"
    make_folder(out, folder)
    write_png16(folder / "mosaic.png", scene.mosaic)
    write_rgb8(folder / "panel.png", panel_picture)
    tone = Tone(display_exposure(scene.ideal))
    for name, picture in (("before", before), ("after", after), ("truth", scene.ideal)):
        write_picture(folder / f"{name}.png", picture, tone)
    return compare_pictures("portrait", before, after, scene.ideal)


def _times_table(times: list[StageTime], seconds: float, compilation_s: float) -> Table:
    """Print the times, with that of compilation, which overlaps the stages and is shorter in the next run."""
    totals = (("in all", f"{seconds:.1f}"), ("compilation, on all threads", f"{compilation_s:.1f}"))
    rows = (*((t.stage, f"{t.seconds:.1f}") for t in times), *totals)
    return Table("Where the time went", ("stage", "s"), rows, frozenset({1}))
