"""The shape of the panel's openings, and an opaque bar through them, are found where they are, and only there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.scenes.psf import pictures, shots_of, small_scene
from udccal.fitting.psf.data import PsfRules
from udccal.fitting.psf.diffraction import DiffractionFit, fit_diffraction
from udccal.fitting.psf.fit import _estimates
from udccal.fitting.psf.kernel import BAR_PLACE, BAR_WIDTH, CORNER, DEPTH_RATIO, SLANT
from udccal.fitting.psf.start import start_model, start_prior
from udccal.numerics import in_float64
from udccal.result import Estimate

_RATIO = 0.25


@in_float64
def fitted(
    axis: int, width: float, place: float, corner: float = 0.0, slant: float = 0.0
) -> tuple[DiffractionFit, np.ndarray]:
    """A fit to pictures by a panel with such openings, and with rows deeper than columns; its true parameters."""
    scene = small_scene(positions=(3, 2), shifts=2, half=(24, 10))
    start = start_model(scene.rig, scene.geometry, scene.wire)
    prior = start_prior(scene.rig, start)
    rng, true = np.random.default_rng(5), prior.mean.copy()
    true[DEPTH_RATIO], true[BAR_WIDTH][axis], true[BAR_PLACE][axis] = _RATIO, width, place
    true[CORNER], true[SLANT][axis] = np.log(np.maximum([corner, slant], 1e-6))
    shots = shots_of(scene, pictures(scene, true, rng), rng)
    rules = replace(PsfRules(), close_px=scene.half)
    return fit_diffraction(shots, scene.geometry, start, prior, rules), true


def numbers_of(fit: DiffractionFit) -> dict[str, Estimate]:
    return {one.name: one for one in _estimates(fit, fit.cov(), 0.01, 0.01, 0.0)[0]}


@pytest.mark.medium
@pytest.mark.parametrize(
    ("axis", "width", "place"), [(1, 0.03, 0.08), (1, 0.02, 0.005), (0, 0.025, 0.3), (1, 0.034, 0.15)]
)
def test_a_bar_is_found_with_its_width_and_place(axis: int, width: float, place: float) -> None:
    fit, true = fitted(axis, width, place)
    assert fit.converged
    assert fit.bar_axis == axis
    assert fit.shape is not None
    assert ("columns", "rows")[axis] in fit.shape.best.name
    sigma = np.sqrt(np.diag(fit.cov()))
    for part in (BAR_WIDTH, BAR_PLACE):
        # Kernels do not tell on which side of the middle it is.
        found, wanted = abs(fit.theta[part][axis]), true[part][axis]
        assert abs(found - wanted) < 4.5 * sigma[part][axis]
    assert sigma[BAR_WIDTH][axis] < 0.1 * width
    numbers = numbers_of(fit)
    of = ("column", "row")[axis]
    assert numbers[f"{of}_bar_width"].value == fit.theta[BAR_WIDTH][axis]
    assert numbers[f"{of}_bar_place"].value == abs(fit.theta[BAR_PLACE][axis])
    assert not {f"{('row', 'column')[axis]}_bar_{name}" for name in ("width", "place")} & set(numbers)
    assert abs(fit.theta[DEPTH_RATIO] - _RATIO) < 4.5 * sigma[DEPTH_RATIO]


_SHAPES_TRIED = ["plain openings (BIC)", "round corners and slants (BIC)"]


@pytest.mark.medium
@pytest.mark.parametrize("corner", [0.08, 0.15])
def test_round_corners_are_found_with_their_radius(corner: float) -> None:
    fit, _ = fitted(0, 0.0, 0.0, corner)
    assert fit.converged
    assert fit.bar_axis is None
    assert fit.shape is not None
    # A bar was not looked for: openings with round corners fit.
    assert [one.name for one in fit.shape.tried] == _SHAPES_TRIED
    numbers = numbers_of(fit)
    radius = numbers["corner_radius"]
    assert abs(radius.value - corner) < 4.5 * radius.sigma
    assert radius.sigma < 0.1 * corner
    # What is not there is small, and does not seem to be sure.
    assert all(numbers[f"{of}_slant"].value < 4.5 * numbers[f"{of}_slant"].sigma for of in ("column", "row"))


@pytest.mark.medium
@pytest.mark.parametrize("axis", [0, 1])
def test_slants_are_found(axis: int) -> None:
    fit, _ = fitted(axis, 0.0, 0.0, slant=0.08)
    assert fit.converged
    assert fit.bar_axis is None
    assert fit.shape is not None
    assert [one.name for one in fit.shape.tried] == _SHAPES_TRIED
    numbers = numbers_of(fit)
    slant, other = (numbers[f"{of}_slant"] for of in (("column", "row") if axis == 0 else ("row", "column")))
    assert abs(slant.value - 0.08) < 4.5 * slant.sigma
    assert slant.sigma < 0.008
    assert other.value < 4.5 * other.sigma
    assert numbers["corner_radius"].value < 4.5 * numbers["corner_radius"].sigma


@pytest.mark.medium
def test_plain_openings_have_neither_bar_nor_corners() -> None:
    fit, _ = fitted(0, 0.0, 0.0)
    assert fit.converged
    assert fit.bar_axis is None
    assert fit.shape is not None
    names = numbers_of(fit)
    assert not {name for name in names if "bar" in name or "corner" in name or "slant" in name}
    # Neither was looked for: plain openings fit.
    assert [one.name for one in fit.shape.tried] == ["plain openings (BIC)"]
