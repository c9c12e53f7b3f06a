from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from procedures.backscatter import BackscatterProcedure
from procedures.base import Bench, Procedure, StepProgress, run_procedure
from procedures.geometry import GeometryProcedure
from procedures.noise import NoiseProcedure
from procedures.plans import TimesThatOf
from procedures.psf import PsfProcedure
from procedures.wire import WireProcedure
from tests.procedures.benches import new_writer, simulated_bench, small_rig
from udccal.arrangements import Arrangement, Dark, Occasion
from udccal.errors import CameraError, CaptureError, SessionError
from udccal.sessions.store import Session
from udccal.sessions.writer import SessionWriter
from udccal.simulation.disturbances import Disturbances


class DarkStage:
    """A person who leaves the light off, whatever the instruction."""

    def __init__(self, bench: Bench) -> None:
        self.bench = bench

    def arrange(self, arrangement: Arrangement, occasion: Occasion) -> None:
        self.bench.stage.arrange(Dark(), occasion)


def test_noise_and_wire_run_unattended(tmp_path: Path) -> None:
    rig, seen = small_rig(), []
    with simulated_bench(rig) as bench:
        writer = new_writer(tmp_path, rig, bench)
        NoiseProcedure().run(bench.camera, bench.display, bench.stage, writer, seen.append)
        run_procedure(WireProcedure(), bench, writer)
    session = Session.open(tmp_path)
    assert [progress.done for progress in seen] == list(range(len(session.steps("noise")) + 1))
    assert all(isinstance(progress, StepProgress) for progress in seen)
    ids = {step.id for step in session.steps("noise")}
    assert {"noise/flat_stack", "noise/dark_stack", "noise/flat_0", "noise/flat_3", "noise/dark_3"} <= ids
    exposures = [session.step(f"noise/{kind}_2").captures[0].exposure_s for kind in ("flat", "dark")]
    assert exposures[0] == exposures[1]
    assert int(session.frame(session.step("noise/flat_3").captures[1]).max()) >= 3500  # into saturation
    (flat,), (dark,) = (session.step(f"wire/{kind}").captures for kind in ("flat", "dark"))
    assert (flat.frames, dark.frames, flat.exposure_s) == (12, 16, dark.exposure_s)
    level = np.percentile(session.average(flat).mean, 99.9) - 64
    assert level / (rig.camera.full_well_e.value * rig.camera.K_DN_per_e.value) == pytest.approx(0.65, abs=0.05)


@pytest.mark.parametrize(
    "procedure", [NoiseProcedure, WireProcedure, PsfProcedure, BackscatterProcedure, GeometryProcedure]
)
def test_every_step_has_its_own_name_and_tells_a_person_what_to_do(procedure: type[Procedure]) -> None:
    rig = small_rig()
    steps = list(procedure().steps(rig))
    assert len(steps) == len({step.id for step in steps})
    for step in steps:
        assert step.id.startswith(f"{procedure.term}/")
        assert step.term == procedure.term
        assert step.instruction.endswith(".")
        assert step.instruction[0].isupper()


def test_resuming_captures_only_what_is_missing(tmp_path: Path) -> None:
    rig = small_rig()

    class Stop(Exception):
        pass

    def stop_at_dark(progress: StepProgress) -> None:
        if progress.step is not None and progress.step.id == "wire/dark":
            raise Stop

    with simulated_bench(rig) as bench:
        writer = new_writer(tmp_path, rig, bench)
        with pytest.raises(Stop):
            run_procedure(WireProcedure(), bench, writer, stop_at_dark)
        before = Session.open(tmp_path).manifest.steps
        assert [step.id for step in before] == ["wire/flat"]
        writer.close()
        with SessionWriter.resume(tmp_path) as again:
            run_procedure(WireProcedure(), bench, again)
    after = Session.open(tmp_path).manifest.steps
    assert after[0] == before[0]
    assert after[1].captures[0].exposure_s == before[0].captures[0].exposure_s


def test_a_damaged_step_is_captured_again_at_the_exposure_that_others_were_captured_at(tmp_path: Path) -> None:
    rig = small_rig()
    with simulated_bench(rig) as bench:
        with new_writer(tmp_path, rig, bench) as writer:
            run_procedure(WireProcedure(), bench, writer)
        before = Session.open(tmp_path)
        file = tmp_path / before.step("wire/flat").captures[0].file
        file.write_bytes(file.read_bytes()[:-1])
        dimmed = Disturbances(flicker_fraction=0.3, flicker_hz=1e-9)  # a lamp 30 % brighter than it was
        with simulated_bench(rig, dimmed) as later, SessionWriter.resume(tmp_path) as writer:
            assert [item.step_id for item in writer.damage] == ["wire/flat"]
            run_procedure(WireProcedure(), later, writer)
    flat, dark = Session.open(tmp_path).manifest.steps
    assert flat.captures[0].sha256 != before.step("wire/flat").captures[0].sha256
    assert flat.captures[0].exposure_s == dark.captures[0].exposure_s == before.step("wire/dark").captures[0].exposure_s


def test_dropped_frames_are_counted(tmp_path: Path) -> None:
    rig = small_rig()
    with simulated_bench(rig, Disturbances(dropped_frame_every=5)) as bench:
        writer = new_writer(tmp_path, rig, bench)
        run_procedure(WireProcedure(), bench, writer)
    (flat,) = Session.open(tmp_path).step("wire/flat").captures
    assert flat.frames == 12
    assert {item.reason for item in flat.rejected} == {"dropped on the way from the camera"}


def test_a_light_leak_shows_in_the_long_dark_frames(tmp_path: Path) -> None:
    rig = small_rig()
    with simulated_bench(rig, Disturbances(leak_e_per_s=1000.0)) as bench:
        writer = new_writer(tmp_path, rig, bench)
        with pytest.raises(CaptureError, match=r"Step noise/dark_4: Expected a dark frame, found .* Cap the lens"):
            run_procedure(NoiseProcedure(), bench, writer)
    assert "noise/flat_stack" in writer.completed_ids


def test_no_light_where_a_flat_should_be_is_refused_and_nothing_is_stored(tmp_path: Path) -> None:
    rig = small_rig()
    with simulated_bench(rig) as bench:
        writer = new_writer(tmp_path, rig, bench)
        with pytest.raises(CaptureError, match=r"Step wire/flat: Expected to see the light, found only"):
            run_procedure(WireProcedure(), replace(bench, stage=DarkStage(bench)), writer)
    assert {item.name for item in tmp_path.iterdir()} == {"session.json", ".session.lock"}


def test_another_camera_than_the_rigs_is_refused(tmp_path: Path) -> None:
    rig = small_rig()
    other = rig.model_copy(update={"camera": rig.camera.model_copy(update={"cfa": "BGGR"})})
    with simulated_bench(rig) as bench:
        writer = new_writer(tmp_path, other, bench)
        with pytest.raises(CameraError, match="Expected a camera of 128 x 96, BGGR, 12 bits"):
            run_procedure(WireProcedure(), bench, writer)


def test_a_step_that_leans_on_a_missing_one_is_refused(tmp_path: Path) -> None:
    rig = small_rig()

    class OnlyDark(Procedure):
        term = "wire"

        def steps(self, rig):
            (step,) = (step for step in WireProcedure().steps(rig) if isinstance(step.exposure, TimesThatOf))
            yield step

    with simulated_bench(rig) as bench, pytest.raises(SessionError, match="Expected the step 'wire/flat' before"):
        run_procedure(OnlyDark(), bench, new_writer(tmp_path, rig, bench))
