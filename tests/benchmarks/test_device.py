"""The benchmark of a GPU says so where there is none."""

from __future__ import annotations

import sys

import jax
import pytest

from tests.benchmarks import device
from tests.benchmarks.pareto.__main__ import main


def test_without_a_gpu_the_benchmark_says_so(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def absent(backend: str) -> list[jax.Device]:
        raise RuntimeError(f"Unknown backend {backend}")

    monkeypatch.setattr(device.jax, "devices", absent)
    monkeypatch.setattr(sys, "argv", ["pareto", "--device", "gpu"])
    assert main() == 0
    assert capsys.readouterr().out == "JAX finds no device 'gpu' here, so nothing is measured.\n"
