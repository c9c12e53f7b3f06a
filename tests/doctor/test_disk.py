from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from procedures.backscatter import BackscatterProcedure
from procedures.base import Procedure, Step
from procedures.geometry import GeometryProcedure
from procedures.noise import NoiseProcedure
from procedures.plans import Bracket, Singles, Stack
from procedures.psf import PsfProcedure
from procedures.wire import WireProcedure
from tests.procedures.benches import small_rig
from tests.toy_rigs import RIGS
from udccal.arrangements import PanelPicture
from udccal.cameras.simulated import SimulatedCamera
from udccal.displays.simulated import SimulatedDisplay
from udccal.doctor.disk import disk_finding, free_bytes
from udccal.doctor.finding import Status
from udccal.doctor.session_size import SessionFiles, captured_bytes, session_bytes, session_files
from udccal.rig import RigDescription, load_rig
from udccal.sessions.manifest import read_manifest
from udccal.sessions.writer import SessionWriter
from udccal.simulation.truth import draw_truth
from udccal.simulation.world import SimulatedWorld

CAPTURED = (NoiseProcedure, WireProcedure, PsfProcedure, BackscatterProcedure)
PROCEDURES = (*CAPTURED, GeometryProcedure)  # too few pixels here to see its board


def small_panel(rig: RigDescription) -> RigDescription:
    """With pictures that take no time to draw."""
    return rig.model_copy(update={"panel": rig.panel.model_copy(update={"columns": 32, "rows": 18})})


def files_of(steps: list[Step], whole: tuple[int, int]) -> SessionFiles:
    averages = frames = cut = pictures = 0
    for step in steps:
        pictures += isinstance(step.arrangement, PanelPicture)
        match step.plan:
            case Stack():
                averages += 1
            case Singles(count) if (step.region.columns, step.region.rows) == whole:
                frames += count
            case Singles(count) | Bracket(count):
                cut += count
    return SessionFiles(averages, frames, cut, pictures)


@pytest.mark.parametrize("name", ["lg55-aca2040", "lg55-reduced", "mk31-imx1600"])
def test_files_are_counted_as_the_procedures_capture_them(name: str) -> None:
    rig = small_panel(load_rig(RIGS / name))
    steps = [step for procedure in PROCEDURES for step in procedure().steps(rig)]
    assert session_files(rig) == files_of(steps, (rig.camera.columns, rig.camera.rows))


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All terms of a small rig but one, captured."""
    folder, rig = tmp_path_factory.mktemp("disk") / "session", small_rig()
    world = SimulatedWorld(draw_truth(rig, 1))
    with SimulatedCamera(world) as camera, SessionWriter.create(folder, rig, camera.identity) as writer:
        for procedure in CAPTURED:
            run(procedure(), camera, world, writer)
    return folder


def run(procedure: Procedure, camera: SimulatedCamera, world: SimulatedWorld, writer: SessionWriter) -> None:
    procedure.run(camera, SimulatedDisplay(world), world, writer)


def test_the_bound_holds_for_files_on_disk(session: Path) -> None:
    manifest = read_manifest(session)
    on_disk = sum(file.stat().st_size for file in session.rglob("*") if file.is_file())
    assert on_disk <= captured_bytes(manifest) < session_bytes(manifest.rig)


def test_the_bound_is_not_far_above_what_a_full_session_takes() -> None:
    """A simulated session of all terms of this rig was 1 500 518 491 bytes long."""
    assert 1.50e9 < session_bytes(load_rig(RIGS / "lg55-aca2040")) < 2 * 1.50e9


def test_room_for_a_whole_session_and_for_the_rest_of_one(session: Path, tmp_path: Path) -> None:
    rig = small_rig()
    whole, rest = session_bytes(rig), session_bytes(rig) - captured_bytes(read_manifest(session))
    new = tmp_path / "not" / "there" / "yet"
    for place, needed in ((new, whole), (session, rest)):
        assert disk_finding(place, rig, lambda folder, size=needed: size).status is Status.OK
        short = disk_finding(place, rig, lambda folder, size=needed: size - 1)
        assert short.status is Status.PROBLEM
        assert "Free" in short.advice
    assert not new.parent.parent.exists()
    assert disk_finding(session, None, lambda folder: rest - 1).status is Status.PROBLEM  # its own rig


def test_without_a_rig_only_the_free_space_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    finding = disk_finding(None, None, lambda folder: 123_000_000_000)
    assert finding.status is Status.OK
    assert finding.found.startswith(f"123.0 GB free in {tmp_path.resolve()}; give --rig")
    assert free_bytes(tmp_path) == pytest.approx(shutil.disk_usage(tmp_path).free, rel=0.5)


def test_a_place_that_cannot_hold_a_session_is_a_problem(session: Path, tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_bytes(b"")
    assert disk_finding(file / "session", small_rig()).status is Status.PROBLEM
    broken = tmp_path / "broken"
    broken.mkdir()
    (broken / "session.json").write_text("{", encoding="utf-8")
    finding = disk_finding(broken, None)
    assert finding.status is Status.PROBLEM
    assert "JSON" in finding.advice


def test_a_session_of_another_rig_is_a_problem(session: Path) -> None:
    """A capture into it would be refused."""
    finding = disk_finding(session, load_rig(RIGS / "lg55-aca2040"), lambda folder: 10**15)
    assert finding.status is Status.PROBLEM
    assert "of the rig 'lg55-aca2040' as it is described now" in finding.advice
    # A lens may be exchanged during a session.
    rig = small_rig()
    other_lens = rig.model_copy(update={"lens": rig.lens.model_copy(update={"model": "another"})})
    assert disk_finding(session, other_lens, lambda folder: 10**15).status is Status.OK


def test_what_is_missing_is_what_was_not_captured(session: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rig = read_manifest(session).rig
    missing = session_bytes(rig) - captured_bytes(read_manifest(session))
    no_views = rig.model_copy(update={"captures": rig.captures.model_copy(update={"board_views": -1})})
    assert missing == session_bytes(rig) - session_bytes(no_views)
    of_no_views = read_manifest(session).model_copy(update={"rig": no_views})
    monkeypatch.setattr("udccal.doctor.disk.read_manifest", lambda path: of_no_views)
    finding = disk_finding(session, no_views, lambda folder: 0)
    assert finding.status is Status.OK
    assert finding.found.endswith("and is complete")
