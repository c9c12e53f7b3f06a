from __future__ import annotations

import sys

import pytest

from udccal.doctor.accelerators import gpu_finding, jax_finding
from udccal.doctor.answers import Failure, JaxDevice
from udccal.doctor.finding import Finding, Status

CPU, CUDA = JaxDevice("cpu", "cpu"), JaxDevice("gpu", "NVIDIA RTX A2000")
WITH_GPU, WITHOUT = Finding("GPU", Status.OK, "one"), Finding("GPU", Status.NOTE, "none")


def gpu(code: str, seconds: float = 20.0) -> Finding:
    return gpu_finding((sys.executable, "-c", code), seconds)


def test_a_gpu_is_shown_as_its_driver_names_it() -> None:
    finding = gpu("print('NVIDIA RTX A2000, 6138 MiB, 580.65.06')\nprint('NVIDIA T400, 2048 MiB, 580.65.06')")
    assert finding.status is Status.OK
    assert finding.found == "NVIDIA RTX A2000, 6138 MiB, 580.65.06; NVIDIA T400, 2048 MiB, 580.65.06"


@pytest.mark.parametrize(
    ("code", "said"),
    [
        ("print('Driver/library version mismatch'); raise SystemExit(18)", "reports: Driver/library version mismatch"),
        ("raise SystemExit(9)", "exit status 9"),
        ("pass", "exit status 0"),
        ("import sys; sys.stdout.buffer.write(bytes(range(128, 256))); sys.exit(1)", "reports"),
        ("print('x' * 1000000)\nraise SystemExit(1)", "reports: xxx"),
    ],
    ids=["mismatch", "status", "silent", "bytes", "flood"],
)
def test_a_driver_that_does_not_work_is_a_note(code: str, said: str) -> None:
    finding = gpu(code)
    assert finding.status is Status.NOTE
    assert said in finding.found
    assert len(finding.found) < 300


def test_no_driver_and_a_hanging_driver_are_notes() -> None:
    assert gpu_finding(("udccal-no-such-command",)).found == "none with NVIDIA's driver"
    assert "does not answer" in gpu("import time; time.sleep(600)", 0.5).found


def test_jax_uses_the_gpu_that_is_there() -> None:
    assert jax_finding((CUDA, CUDA), WITH_GPU).found == "2 x gpu (NVIDIA RTX A2000)"
    assert jax_finding((CUDA,), WITH_GPU).status is Status.OK
    assert jax_finding((CPU,), WITHOUT).status is Status.OK
    unused = jax_finding((CPU,), WITH_GPU)
    assert unused.status is Status.NOTE
    assert "pip install 'jax[cuda13]'" in unused.advice


def test_without_jax_nothing_can_be_fitted() -> None:
    assert jax_finding(Failure("ImportError: no"), WITHOUT).status is Status.PROBLEM
