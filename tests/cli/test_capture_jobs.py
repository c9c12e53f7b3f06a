"""Captures with files, and with a person, through the jobs that the command runs."""

from __future__ import annotations

from pathlib import Path

import pytest

from procedures.noise import NoiseProcedure
from tests.cli.step_pictures import photograph_steps
from tests.toy_rigs import write_toy_rig
from udccal.arrangements import Dark, FlatLight, Occasion
from udccal.benches.bench import CaptureBench, simulated_bench, simulated_rig
from udccal.benches.capture import capture
from udccal.cli.jobs.benches import files_bench
from udccal.cli.jobs.person import PersonStage
from udccal.cli.output import Output
from udccal.errors import CameraError, CaptureError, UdccalError
from udccal.fitting.noise.data import read_noise
from udccal.fitting.noise.fit import fit_noise
from udccal.rig import RigDescription, load_rig
from udccal.sessions.store import Session


@pytest.fixture
def rig(tmp_path: Path) -> RigDescription:
    return load_rig(write_toy_rig(tmp_path))


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
