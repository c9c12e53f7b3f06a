"""Captures with files through the jobs that the command runs."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.cli.step_pictures import photograph_steps
from tests.toy_rigs import write_toy_rig
from udccal.benches.bench import simulated_rig
from udccal.benches.capture import capture
from udccal.cli.jobs.benches import files_bench
from udccal.cli.output import Output
from udccal.errors import CameraError
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
