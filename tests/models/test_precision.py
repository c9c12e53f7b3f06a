"""Terms in single precision, as a program has them that never switched JAX to 64 bits."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from udccal.models.backscatter import backscatter_rate
from udccal.models.psf import psf_kernels
from udccal.models.wire import wire_map
from udccal.numerics import in_float64
from udccal.profiles.profile import Profile
from udccal.profiles.store import find_profile, read_profile

PANEL = np.full((1080, 1920, 3), 128, np.uint8)
EVALUATED: dict[str, tuple[Callable[[Profile], np.ndarray], float]] = {
    "wire": (lambda p: np.asarray(wire_map(p.wire.term, 96, 128)), 1e-5),
    "psf": (lambda p: np.asarray(psf_kernels(p.psf.term, np.array([[250.0, 120.0]]), 61, 41)), 1e-4),
    "backscatter": (lambda p: np.asarray(backscatter_rate(p.backscatter.term, PANEL)), 1e-5),
}


# The psf takes a minute to compile.
@pytest.mark.parametrize(
    "term", [pytest.param(term, marks=pytest.mark.slow if term == "psf" else ()) for term in EVALUATED]
)
@pytest.mark.medium
def test_single_precision_is_close_to_double(term: str) -> None:
    evaluate, limit = EVALUATED[term]
    profile = read_profile(find_profile("lg55-reduced"))
    single, double = evaluate(profile), in_float64(evaluate)(profile)
    assert (single.dtype, double.dtype) == (np.float32, np.float64)
    assert np.linalg.norm(single - double) < limit * np.linalg.norm(double)
