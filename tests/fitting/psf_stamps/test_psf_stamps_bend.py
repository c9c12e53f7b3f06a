"""Stars whose peaks are compressed: a response that bends is named, and straight ones are not."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tests.scenes.stamps import drawn
from udccal.fitting.psf_stamps.fit import fit_psf_stamps
from udccal.fitting.psf_stamps.term import StampsPsf
from udccal.result import FitResult, FitStatus


def fitted(missing: float, seed: int) -> FitResult[StampsPsf]:
    """The fit of stars whose brightest peak lacks this part of its light."""
    stamps = drawn("moffat", seed, count=40, size=21).stamps
    value = stamps.values_e
    bent = replace(stamps, values_e=value * (1 - missing * value / value.max()))
    return fit_psf_stamps(bent)


@pytest.mark.medium
@pytest.mark.parametrize("missing", [0.08, -0.07])
def test_a_response_that_bends_is_named(missing: float) -> None:
    """Peaks compressed by 8 % made kernels 2 % wrong where 0.5 % were stated."""
    result = fitted(missing, 1)
    assert result.status is FitStatus.POOR_FIT
    note = next(note for note in result.notes if "the response bends" in note)
    assert ("lower" in note) == (missing > 0)


@pytest.mark.medium
@pytest.mark.parametrize("seed", [1, 2])
def test_a_straight_response_is_not(seed: int) -> None:
    result = fitted(0.0, seed)
    assert result.status is FitStatus.CONVERGED
    assert not any("bends" in note for note in result.notes)
