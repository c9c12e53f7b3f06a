"""A psf field from stamps: how many stamps, and pixels of each; orders are found along with it."""

from __future__ import annotations

from collections.abc import Callable

from tests.benchmarks.growth.cases import Case
from tests.scenes.two_gaussians import make
from udccal.fitting.psf_stamps.fit import fit_psf_stamps

# Pixels along a stamp's side, by its pixels.
_SIDES = {225: 15, 441: 21, 961: 31}
_STAMPS, _PIXELS = 30, 225


def _work(stamps: int, pixels: int) -> Callable[[], object]:
    made, _ = make(1, stamps, _SIDES[pixels])
    return lambda: fit_psf_stamps(made).or_raise()


CASES = (
    Case("psf_stamps", "stamps", (30, 60, 120), lambda stamps: _work(stamps, _PIXELS)),
    Case("psf_stamps", "pixels of a stamp", tuple(_SIDES), lambda pixels: _work(_STAMPS, pixels)),
)
