"""Boards whose points are off, each its own way, in all views alike."""

from __future__ import annotations

import numpy as np
import pytest

from tests.fitting.geometry.boards import calibrated, sight
from udccal.board.charuco import board_points_mm
from udccal.fitting.geometry.bundle import Intrinsics

_OFF_MM = 0.3
_TOLD = "points of the board are off their description by"


def _in_sigma(seed: int, off_mm: float) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """Errors of focal lengths and centre in sigma, these sigmas, and notes, for a print drawn by the seed."""
    scene, rng = sight(seed, views=14), np.random.default_rng(seed)
    flat = board_points_mm(scene.spec)
    printed = flat + off_mm * rng.standard_normal(flat.shape) * np.array([1.0, 1.0, 0.0])
    found = calibrated([flat] * 14, scene.pictures(printed, rng), scene.size)
    sigma = np.sqrt(np.diag(found.cov))[:4]
    truth = Intrinsics.of_geometry(scene.camera).vector[:4]
    return (found.intrinsics.vector[:4] - truth) / sigma, sigma, found.notes


@pytest.mark.medium
def test_a_poor_print_is_named_and_biases_no_lens() -> None:
    """It moves corners by three times their noise; without its points in the fit, centres were up to 9 sigma off."""
    z, sigmas, notes = zip(*(_in_sigma(seed, _OFF_MM) for seed in range(8)), strict=True)
    assert all(any(_TOLD in note for note in own) for own in notes)
    size = [float(note.split(_TOLD)[1].split()[0]) for own in notes for note in own if _TOLD in note]
    assert np.median(size) == pytest.approx(_OFF_MM, rel=0.1)
    assert np.abs(z).max() < 4.0
    assert 0.75 < np.sqrt(np.mean(np.square(z))) < 1.3
    exact = np.array([_in_sigma(seed, 0.0)[1] for seed in range(8)])
    wider = np.median(np.array(sigmas) / exact, axis=0)
    assert (wider < [1.3, 1.3, 3.5, 3.5]).all(), "the views tell where points are, but for shifts like the centre's"


def test_an_exact_print_is_taken_as_described() -> None:
    for seed in range(8):
        z, _, notes = _in_sigma(seed, 0.0)
        assert not any(_TOLD in note for note in notes)
        assert np.abs(z).max() < 4.0
