from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.benchmarks.pareto.instead import Peer, _dehazed, _richardson_lucy, _wiener, demosaiced, peer_rows
from tests.benchmarks.pareto.made_runs import DB, MS, good_runs
from udccal.cfa import cfa_named
from udccal.tiers import Tier

RUNS = good_runs()
SCENES = ("a, nineteen", "b, nineteen")


def test_a_peer_that_is_slower_and_worse_is_beaten() -> None:
    (row,) = peer_rows([Peer("other", (DB[Tier.fast] - 2.0,), MS[Tier.fast] + 1.0)], RUNS, SCENES)
    assert row.ok
    assert row.value == pytest.approx(2.0)


@pytest.mark.parametrize(
    "peer",
    [
        Peer("as good as balanced in the time of fast", (DB[Tier.balanced],), MS[Tier.fast]),
        Peer("quicker than every tier", (20.0,), 0.5 * MS[Tier.preview]),
        Peer("no number", (float("nan"),), 1e6),
    ],
)
def test_a_peer_that_no_tier_beats_is_told(peer: Peer) -> None:
    (row,) = peer_rows([peer], RUNS, SCENES)
    assert not row.ok


def test_other_scenes_do_not_count() -> None:
    better = [replace(run, after_dB=90.0) if run.scene == "b, nineteen" else run for run in RUNS]
    (row,) = peer_rows([Peer("other", (DB[Tier.accurate],), 1e6)], better, SCENES[:1])
    assert row.value == pytest.approx(0.0)


def test_deblurring_of_others_sharpens() -> None:
    rng = np.random.default_rng(0)
    sharp = cv2.GaussianBlur(rng.random((96, 96), dtype=np.float32), (0, 0), 1.0)
    kernel = np.zeros((15, 15), np.float32)
    kernel[:, 7] = cv2.getGaussianKernel(15, 2.0)[:, 0]
    blurred = cv2.filter2D(sharp, cv2.CV_32F, kernel)
    inner = np.s_[24:-24, 24:-24]

    def rms(picture: np.ndarray) -> float:
        return float(np.sqrt(np.mean((picture - sharp)[inner] ** 2)))

    for deblur in (_wiener(0.003), _richardson_lucy(20)):
        assert rms(np.asarray(deblur(blurred, kernel))) < 0.8 * rms(blurred)
        assert rms(np.asarray(deblur(blurred, kernel.T))) > rms(blurred)


def test_even_colours_are_demosaiced_and_haze_is_taken_off() -> None:
    colours = np.array([800.0, 2000.0, 400.0], np.float32)
    for cfa in ("RGGB", "GRBG"):
        picture = demosaiced(colours[cfa_named(cfa).channel_map(32, 40)], cfa)
        np.testing.assert_allclose(picture, np.broadcast_to(colours, picture.shape), rtol=1e-3)
    scene = np.full((120, 160, 3), 0.02, np.float32)
    scene[40:80, 60:100] = (0.6, 0.1, 0.05)
    hazy = 0.5 * scene + 0.5
    hazy[:8] = 1.0
    clear = _dehazed(hazy)
    assert np.abs(clear - scene)[90:].mean() < 0.3 * np.abs(hazy - scene)[90:].mean()
