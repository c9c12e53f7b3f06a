"""Libraries in environments of their own: absent ones, broken ones, and what is prepared for those that run."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
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
from tests.scenes.toy_restorer import EXPOSURE_S, NOISE, exposed, made, taken
from udccal.arrangements import Photograph
from udccal.models.geometry import Geometry
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
        # That of the tests, which has numpy and neither library.
        _write(other.python(tmp_path), f'exec "{sys.executable}" "$@"')
    peers = others_of(fast, [sight], tmp_path)
    assert all(math.isnan(peer.ms) for peer in peers)
    assert not any(row.ok for row in peer_rows(peers, good_runs(), ["a, nineteen"]))
    assert "No module named 'regularizepsf'" in capsys.readouterr().err


def test_a_library_that_returns_what_it_is_given_has_it_in_its_place(tmp_path: Path) -> None:
    """The view needs some rows of a tall sensor only, and so does what a library is given."""
    toy, geometry, rows = toy_restorer.rig(), toy_restorer.geometry(), 200
    wide = toy.view.model_copy(update={"rows": 16})
    rig = toy.model_copy(update={"camera": toy.camera.model_copy(update={"rows": rows}), "view": wide})
    middle = np.array([geometry.principal_point_px[0], rows / 2])
    tall = made(
        Tier.fast,
        rig,
        NOISE,
        Geometry(**{**vars(geometry), "principal_point_px": middle}),
        toy_restorer.grid(),
        needed_alone=True,
    )
    assert tall.sharpener is not None
    assert 0 < tall.sharpener.rows.start != tall.rows.start
    waves = 3000 + 2000 * np.sin(np.arange(rows) / 9)[:, None, None]
    scene = np.broadcast_to(waves, (rows, toy_restorer.COLUMNS, 3)).astype(np.float32)
    frame = taken(replace(tall, wire=None), scene[..., 0], seed=1)
    ideal = tall.rectification.apply(np.ascontiguousarray(scene)) / np.float32(5000)
    shot = Shot("a", Photograph(EMPTY, 1.0, 1.0), 1.0, EMPTY[..., 0], ideal, 0)
    own = Sight(Case(Group.nineteen, shot, USUAL), 1.0, Taken(frame, EXPOSURE_S, None), 20.0)
    echo = (
        "import sys, numpy as np; given, result = sys.argv[3:]; stored = np.load(given);"
        "np.savez(result, restored=stored['pictures'][None], seconds=np.ones((1, 1)))"
    )
    for other in OTHERS:
        _write(other.python(tmp_path), f'exec "{sys.executable}" -c "{echo}" "$@"')
    even = replace(tall, wire=None)
    assert min(peer.dB[0] for peer in others_of(even, [own], tmp_path)) > 35
    flipped = replace(own, case=replace(own.case, shot=replace(shot, ideal=np.roll(ideal, 4, axis=0))))
    assert max(peer.dB[0] for peer in others_of(even, [flipped], tmp_path)) < 30


def _write(python: Path, line: str) -> None:
    """An interpreter that does something else."""
    python.parent.mkdir(parents=True)
    python.write_text(f"#!/bin/sh\n{line}\n", encoding="utf-8")
    python.chmod(0o755)


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
