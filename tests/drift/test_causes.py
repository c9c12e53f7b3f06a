"""Which causes explain a change of the pose."""

from __future__ import annotations

import numpy as np
import pytest

from udccal.drift.causes import CAUSES, explained

CHANCE = 1e-3


def cov(rng: np.random.Generator) -> np.ndarray:
    """Strongly correlated errors, as those of offset and rotation are."""
    root = rng.normal(size=(7, 7)) * np.array([1e-4, 1e-4, 1e-5, 3e-4, 2e-3, 5e-3, 4e-4])[:, None]
    return np.asarray(root @ root.T)


def change(causes: tuple[str, ...], sigmas: float, spread: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A change by these causes, each of some sigma in a direction that the others cannot imitate, and noise."""
    values = np.zeros(7)
    for cause in causes:
        at = np.array(CAUSES[cause])
        information = np.linalg.inv(spread)[np.ix_(at, at)]
        way = rng.normal(size=len(at))
        values[at] = sigmas * way / np.sqrt(way @ information @ way)
    return values + rng.multivariate_normal(np.zeros(7), spread, method="eigh")


def test_noise_alone_has_no_cause() -> None:
    rng = np.random.default_rng(0)
    found = [explained(change((), 0, spread, rng), spread, CHANCE).causes for spread in (cov(rng) for _ in range(300))]
    assert sum(causes != () for causes in found) <= 2


@pytest.mark.parametrize("causes", [("moved",), ("tilted",), ("refocused",), ("moved", "tilted")])
def test_what_was_done_is_what_is_found(causes: tuple[str, ...]) -> None:
    rng = np.random.default_rng(1)
    right = 0
    for _ in range(100):
        spread = cov(rng)
        values = change(causes, 100.0, spread, rng)
        found = explained(values, spread, CHANCE)
        right += set(found.causes) == set(causes)
        kept = np.array(sorted(index for cause in found.causes for index in CAUSES[cause]))
        rest = np.setdiff1d(np.arange(7), kept)
        assert not found.values[rest].any()
    # A small change may look like another one whose errors it shares.
    assert right >= 85


def test_each_cause_has_the_sigma_that_it_would_have_alone() -> None:
    spread = np.diag(np.arange(1.0, 8.0) ** 2)
    found = explained(np.zeros(7), spread, CHANCE)
    assert np.sqrt(np.diag(found.cov)) == pytest.approx(np.arange(1.0, 8.0))
