"""Captures with files, and with a person, through the jobs that the command runs."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from procedures.noise import NoiseProcedure
from procedures.plans import Fixed, Metered, Stack
from tests.toy_rigs import write_toy_rig
from udccal.arrangements import Dark, FlatLight, Occasion
from udccal.benches.bench import CaptureBench, simulated_bench, simulated_rig
from udccal.benches.capture import capture
from udccal.cameras.protocol import Settings
from udccal.cameras.simulated import SimulatedCamera
from udccal.cli.jobs.benches import files_bench
from udccal.cli.jobs.person import PersonStage
from udccal.cli.output import Output
from udccal.errors import CameraError, CaptureError, UdccalError
from udccal.fitting.noise.data import read_noise
from udccal.fitting.noise.fit import fit_noise
from udccal.io.png import write_png16
from udccal.rig import RigDescription, load_rig
from udccal.sessions.store import Session


@pytest.fixture
def rig(tmp_path: Path) -> RigDescription:
    return load_rig(write_toy_rig(tmp_path))


def photograph_steps(rig: RigDescription, root: Path) -> None:
    """What a person with another camera does: pictures of every step of the noise term, in a folder each."""
    world = simulated_rig(rig, seed=2)
    stack_s = 4.4e-3
    with SimulatedCamera(world) as camera:
        for number, step in enumerate(NoiseProcedure().steps(rig)):
            world.arrange(step.arrangement, Occasion(step.id, number, step.instruction))
            match step.exposure:
                case Metered():
                    exposure_s = stack_s
                case Fixed(exposure_s):
                    pass
                case other:
                    exposure_s = other.factor * stack_s
            camera.configure(Settings(max(exposure_s, rig.camera.min_exposure_s), 0.0, camera.sensor))
            folder = root / step.id
            folder.mkdir(parents=True)
            lines = ["file,exposure_s"]
            frames = step.plan.frames + (2 if isinstance(step.plan, Stack) else 1)
            for frame in camera.frames(frames):
                name = f"{frame.frame_id:06d}.png"
                write_png16(folder / name, frame.data)
                lines.append(f"{name},{frame.settings.exposure_s!r}")
            (folder / "frames.csv").write_text("\n".join(lines) + "\n")


def test_pictures_of_any_camera_make_a_session(tmp_path: Path, rig: RigDescription) -> None:
    root = tmp_path / "pictures"
    photograph_steps(rig, root)
    late = root / "noise" / "dark_2"
    late.rename(tmp_path / "late")
    with (
        files_bench(Output(), rig, root, tmp_path / "shown") as bench,
        pytest.raises(CameraError, match=r"pictures of the step noise/dark_2 .* Cap the lens.* Put the files there"),
    ):
        capture(tmp_path / "session", bench, ("noise",))
    (tmp_path / "late").rename(late)
    with files_bench(Output(), rig, root, tmp_path / "shown") as bench:
        capture(tmp_path / "session", bench, ("noise",))
    session = Session.open(tmp_path / "session")
    assert session.camera.backend == "files"
    result = fit_noise(read_noise(session))
    truth = simulated_rig(rig, seed=2).truth.sensor
    assert float(result.term.K_DN_per_e) == pytest.approx(truth.K_DN_per_e, rel=0.02)


@pytest.mark.medium
def test_milliseconds_for_seconds_are_refused_at_their_step(tmp_path: Path, rig: RigDescription) -> None:
    root = tmp_path / "pictures"
    photograph_steps(rig, root)
    table = root / "noise" / "flat_2" / "frames.csv"
    right = table.read_text()
    head, *lines = right.splitlines()
    in_ms = [f"{name},{1000 * float(exposure_s)!r}" for name, exposure_s in (line.split(",") for line in lines)]
    table.write_text("\n".join((head, *in_ms)) + "\n")
    words = ["calibrate", "--rig", tmp_path / "toy", "--camera", "files", "--files", root, "--term", "noise", "--json"]
    words += ["--session", tmp_path / "session", "--profile", tmp_path / "profile"]
    command = [sys.executable, "-m", "udccal.cli.main", *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=280)
    assert done.returncode == 1, done.stderr
    sentence = json.loads(done.stdout)["error"]
    assert sentence.startswith("Step noise/flat_2: Expected an exposure near 0.0051 s")
    assert "found 5.1 s: 1000 times too long" in sentence
    assert "milliseconds (ms)" in sentence
    assert [step.id for step in Session.open(tmp_path / "session").manifest.steps][-1] == "noise/flat_1"
    table.write_text(right)
    with files_bench(Output(), rig, root, tmp_path / "shown") as bench:
        capture(tmp_path / "session", bench, ("noise",))


@pytest.fixture
def keyboard(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    answers: list[str] = []

    def read(prompt: str = "") -> str:
        if not answers:
            raise EOFError
        return answers.pop(0)

    monkeypatch.setattr("builtins.input", read)
    return answers


def test_a_person_is_told_once_and_asked_again_after_a_mistake(
    keyboard: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    person = PersonStage(Output())
    keyboard += ["", "", "", "q"]
    person.arrange(Dark(), Occasion("noise/dark_0", 0, "Cap the lens."))
    person.arrange(Dark(), Occasion("noise/dark_1", 1, "Cap the lens."))
    assert len(keyboard) == 3
    assert "noise/dark_0: Cap the lens." in capsys.readouterr().err
    assert person.try_again("Expected a dark frame, found light.")
    person.arrange(Dark(), Occasion("noise/dark_1", 1, "Cap the lens."))
    assert not person.try_again("Expected a dark frame, found light.")
    assert keyboard == []
    with pytest.raises(UdccalError, match="standard input is closed"):
        person.arrange(FlatLight(), Occasion("noise/flat_0", 2, "Put the panel in front."))


class Forgetful:
    """A stage where the light is off the first time it should be on."""

    def __init__(self, bench: CaptureBench) -> None:
        self.bench, self.forgot, self.said = bench, False, []

    def arrange(self, arrangement, occasion: Occasion) -> None:
        if isinstance(arrangement, FlatLight) and not self.forgot:
            arrangement, self.forgot = Dark(), True
        self.bench.stage.arrange(arrangement, occasion)

    def try_again(self, sentence: str) -> bool:
        self.said.append(sentence)
        return len(self.said) < 2


def test_a_step_that_was_refused_is_repeated_alone(tmp_path: Path, rig: RigDescription) -> None:
    with simulated_bench(simulated_rig(rig, seed=0)) as plain:
        stage = Forgetful(plain)
        bench = CaptureBench(plain.rig, plain.camera, plain.display, stage, plain.now, stage.try_again)
        capture(tmp_path / "session", bench, ("noise",))
        assert len(stage.said) == 1
        assert "noise/flat_stack: Expected to see the light" in stage.said[0]
        stage.forgot = False
        with pytest.raises(CaptureError, match="wire/flat"):
            capture(tmp_path / "session", bench, ("wire",))
    assert len(Session.open(tmp_path / "session").steps("noise")) == sum(1 for _ in NoiseProcedure().steps(rig))
