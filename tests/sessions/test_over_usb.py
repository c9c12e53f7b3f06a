"""A session of the simulated rig, captured through the USB3 Vision driver, faults of the cable and all."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.toy_rigs import write_toy_rig
from tests.virtual_u3v.backend import VirtualBackend
from tests.virtual_u3v.camera import VirtualCamera
from tests.virtual_u3v.faults import Faults
from tests.virtual_u3v.rig_source import RigSource, model_of_rig
from udccal.benches.bench import CaptureBench, simulated_rig
from udccal.benches.capture import capture
from udccal.cameras.choice import mode_for
from udccal.cameras.u3v.camera import U3vCamera
from udccal.displays.simulated import SimulatedDisplay
from udccal.errors import CameraError, CameraLost
from udccal.fitting.noise.data import read_noise
from udccal.fitting.noise.fit import fit_noise
from udccal.result import FitStatus
from udccal.rig import RigDescription, load_rig
from udccal.sessions.store import Session
from udccal.simulation.world import SimulatedWorld


@pytest.fixture
def rig(tmp_path: Path) -> RigDescription:
    return load_rig(write_toy_rig(tmp_path))


@contextmanager
def bench_over_usb(rig: RigDescription, world: SimulatedWorld, device: VirtualCamera) -> Iterator[CaptureBench]:
    with U3vCamera(backend=VirtualBackend([device])) as camera:
        camera.set_mode(mode_for(camera.features, camera.sensor, rig.camera.cfa, rig.camera.bits))
        description = world.truth.description
        yield CaptureBench(description, camera, SimulatedDisplay(world), world, world.now)


def rejections(session: Session) -> Counter[str]:
    captures = (capture for step in session.manifest.steps for capture in step.captures)
    return sum((Counter({item.reason: item.frames}) for capture in captures for item in capture.rejected), Counter())


@pytest.mark.medium
def test_a_session_over_usb_fits_like_one_without(tmp_path: Path, rig: RigDescription) -> None:
    world = simulated_rig(rig, seed=2)
    with bench_over_usb(rig, world, VirtualCamera(model_of_rig(world), RigSource(world))) as bench:
        assert bench.camera.mode.pixel_format == "BayerRG12p"
        capture(tmp_path / "session", bench, ("noise",))
        assert bench.camera.counts.dropped == bench.camera.counts.incomplete == 0
    session = Session.open(tmp_path / "session")
    assert session.camera.backend == "u3v"
    result = fit_noise(read_noise(session))
    assert result.status is FitStatus.CONVERGED
    assert float(result.term.K_DN_per_e) == pytest.approx(world.truth.sensor.K_DN_per_e, rel=0.03)


def test_what_the_cable_spoils_is_replaced_and_counted(tmp_path: Path, rig: RigDescription) -> None:
    world = simulated_rig(rig, seed=2)
    device = VirtualCamera(model_of_rig(world), RigSource(world))
    frames = range(1000)
    faults = Faults(short_frames=tuple(frames[25::9]), dropped_frames=tuple(frames[20::7]))
    with bench_over_usb(rig, world, device) as bench:
        device.inject(faults)
        capture(tmp_path / "session", bench, ("wire",))
        counts = bench.camera.counts
    session = Session.open(tmp_path / "session")
    found = rejections(session)
    assert set(found) == {"incomplete", "dropped on the way from the camera"}
    assert 0 < found["incomplete"] <= counts.incomplete
    assert 0 < found["dropped on the way from the camera"] <= counts.dropped
    assert session.step("wire/flat").captures[0].frames == rig.captures.flats


@pytest.mark.medium
def test_an_unplugged_camera_costs_the_step_in_hand(tmp_path: Path, rig: RigDescription) -> None:
    world = simulated_rig(rig, seed=2)
    device = VirtualCamera(model_of_rig(world), RigSource(world))
    with bench_over_usb(rig, world, device) as bench:
        device.inject(Faults(unplug_at_frame=40))
        with pytest.raises(CameraLost, match=r"Expected .* found"):
            capture(tmp_path / "session", bench, ("noise", "wire"))
    before = Session.open(tmp_path / "session").manifest.steps
    assert 0 < len(before) < 20
    with pytest.raises(CameraError, match=r"Expected .* found"), bench_over_usb(rig, world, device):
        pass
    device.inject(Faults())
    device.plug()
    with bench_over_usb(rig, world, device) as bench:
        capture(tmp_path / "session", bench, ("noise", "wire"))
    after = Session.open(tmp_path / "session").manifest.steps
    assert after[: len(before)] == before
    assert {"wire/flat", "wire/dark"} <= {step.id for step in after}
