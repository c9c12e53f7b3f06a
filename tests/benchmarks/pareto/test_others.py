"""Libraries in environments of their own: absent ones, broken ones, and what is prepared for those that run."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.benchmarks.pareto.by_others import _components, _hats
from tests.benchmarks.pareto.groups import USUAL, Case, Group
from tests.benchmarks.pareto.instead import peer_rows, peer_table
from tests.benchmarks.pareto.made_runs import good_runs
from tests.benchmarks.pareto.others import OTHERS, others_of
from tests.benchmarks.pareto.restoring import Taken
from tests.benchmarks.pareto.runs import Sight
from tests.benchmarks.pictures import Shot
from tests.scenes import toy_restorer
from tests.scenes.toy_restorer import EXPOSURE_S, NOISE, exposed, made
from udccal.arrangements import Photograph
from udccal.restoration.runtime import Restorer
from udccal.tiers import Tier

EMPTY = np.zeros((1, 1, 3), np.float32)


@pytest.fixture(scope="module")
def fast() -> Restorer:
    return made(Tier.fast, toy_restorer.rig(), NOISE, toy_restorer.geometry(), toy_restorer.grid())


@pytest.fixture(scope="module")
def sight(fast: Restorer) -> Sight:
    shot = Shot("a, nineteen", Photograph(EMPTY, 1.0, 1.0), 1.0, EMPTY[..., 0], EMPTY, 0)
    frame = exposed(fast, toy_restorer.grid(), toy_restorer.scene())
    return Sight(Case(Group.nineteen, shot, USUAL), 1.0, Taken(frame, EXPOSURE_S, None), 20.0)


def test_libraries_that_are_absent_say_that_they_were_not_run(fast: Restorer, sight: Sight, tmp_path: Path) -> None:
    peers = others_of(fast, [sight], tmp_path)
    assert [peer.dB for peer in peers] == [(), ()]
    rows = peer_rows(peers, good_runs(), ["a, nineteen"])
    assert all(row.ok and "was not run" in row.name for row in rows)
    assert peer_table(peers).count("| not run |") == 2


def test_an_environment_without_its_library_is_told(
    fast: Restorer, sight: Sight, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for other in OTHERS:
        python = other.python(tmp_path)
        python.parent.mkdir(parents=True)
        # That of the tests, which has numpy and neither library.
        python.write_text(f'#!/bin/sh\nexec "{sys.executable}" "$@"\n', encoding="utf-8")
        python.chmod(0o755)
    peers = others_of(fast, [sight], tmp_path)
    assert all(math.isnan(peer.ms) for peer in peers)
    assert not any(row.ok for row in peer_rows(peers, good_runs(), ["a, nineteen"]))
    assert "No module named 'regularizepsf'" in capsys.readouterr().err


def test_components_and_weights_are_the_kernels() -> None:
    grid = toy_restorer.grid()
    # Of rank 2.
    mixed = 0.3 * grid.kernels[:1, :1] + np.linspace(0, 1, 5)[None, :, None, None, None] * grid.kernels[-1:, -1:]
    filters, weights = _components(np.repeat(mixed, 4, axis=0))
    again = np.einsum("ckyx,cijk->ijcyx", filters, weights)
    np.testing.assert_allclose(again, np.repeat(mixed, 4, axis=0), atol=1e-6)
    assert np.abs(weights[..., 2:]).max() < 1e-6 < np.abs(weights[..., 1]).max()


def test_hats_interpolate_and_stay_constant_outside() -> None:
    hats = _hats(np.array([0.0, 10.0, 30.0]), np.array([-5.0, 5.0, 20.0, 40.0]))
    np.testing.assert_allclose(hats.T, [[1, 0, 0], [0.5, 0.5, 0], [0, 0.5, 0.5], [0, 0, 1]])
