"""Tails are those of scipy.stats, and never NaN."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from udccal.fitting.engine.misfit import chi2_tail, f_tail


@pytest.mark.parametrize("dof", [1.0, 3.0, 47.5, 1e6])
@pytest.mark.parametrize("per_dof", [0.0, 0.5, 1.0, 1.3, 40.0, np.inf])
def test_tails_are_those_of_the_distributions(dof: float, per_dof: float) -> None:
    assert chi2_tail(per_dof * dof, dof) == pytest.approx(stats.chi2.sf(per_dof * dof, dof), rel=1e-9, abs=1e-300)
    assert f_tail(per_dof, dof, 20.0) == pytest.approx(stats.f.sf(per_dof, dof, 20.0), rel=1e-9, abs=1e-300)


@pytest.mark.parametrize(
    "tail", [chi2_tail(-0.1, 3.0), chi2_tail(5.0, 0.0), f_tail(-0.1, 3.0, 9.0), f_tail(5.0, 0.0, 9.0)]
)
def test_nothing_compared_is_never_unlikely(tail: float) -> None:
    assert tail == 1.0
