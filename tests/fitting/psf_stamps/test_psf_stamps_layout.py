"""Where stars lie: on a line or at a few places they determine no field, and far from them nothing is stated."""

from __future__ import annotations

import numpy as np
import pytest

from tests.scenes.two_gaussians import READ_E, SENSOR
from udccal.errors import FitError
from udccal.fitting.psf_stamps.data import Stamps
from udccal.fitting.psf_stamps.fit import fit_psf_stamps
from udccal.result import FitResult, FitStatus

_ALONG = np.linspace(0.06, 0.94, 26)


def fitted(position: np.ndarray) -> FitResult:
    """Of Gaussians that are wider away from the field's middle, at positions relative to the sensor."""
    rng = np.random.default_rng(3)
    position_px = np.rint(position * SENSOR).astype(int)
    y, x = np.mgrid[:11, :11] - 5
    width = 1.3 * (1 + 0.15 * ((2 * position - 1) ** 2).sum(axis=1))[:, None, None]
    shift = rng.uniform(-0.5, 0.5, (2, len(position), 1, 1))
    light = 1e5 * np.exp(-0.5 * ((x - shift[0]) ** 2 + (y - shift[1]) ** 2) / width**2) / (2 * np.pi * width**2)
    values = rng.poisson(light) + READ_E * rng.standard_normal(light.shape)
    return fit_psf_stamps(Stamps(values, position_px, READ_E))


LAYOUTS = {
    "row": np.stack([_ALONG, np.full(26, 0.5)], axis=1),
    "diagonal": np.stack([_ALONG, 0.1 + 0.7 * _ALONG], axis=1),
    "two rows": np.stack([np.tile(_ALONG[::2], 2), np.repeat([0.1, 0.9], 13)], axis=1),
    "two places": np.repeat([[0.2, 0.2], [0.8, 0.7]], 13, axis=0),
    "three places": np.repeat([[0.2, 0.2], [0.8, 0.7], [0.2, 0.9]], 9, axis=0),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_stars_on_lines_or_at_few_places_determine_no_field(layout: str) -> None:
    result = fitted(LAYOUTS[layout])
    assert result.status is FitStatus.TOO_FEW_DATA
    assert "Spread them over the field" in result.notes[0]


def test_a_strip_tells_its_psf_and_refuses_places_far_from_it() -> None:
    across = np.random.default_rng(4).uniform(-0.002, 0.002, len(_ALONG))
    strip = np.stack([_ALONG, 0.5 + across], axis=1)
    result = fitted(strip)
    assert result.status is FitStatus.CONVERGED
    assert result.term.relative_l2(np.array([[0.5, 0.5]]) * SENSOR)[0, 0] < 0.03
    with pytest.raises(FitError, match="Ask for positions nearer to them"):
        result.term.predict(np.array([[0.5, 0.5], [0.2, 0.9]]) * SENSOR)
    with pytest.raises(FitError, match="add stars there"):
        result.term.sigma(np.array([[1e6, 1e6]]))


def test_stars_about_an_empty_middle_are_fitted() -> None:
    """The map there is nobody's measurement, and stops no fit; those who ask are answered or refused."""
    angle = np.linspace(0.0, 2 * np.pi, 26, endpoint=False)
    result = fitted(0.5 + 0.44 * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    assert result.term.relative_l2(result.term.star_px).shape == (26, 2)
    assert result.status is not FitStatus.CONVERGED or result.term.sigma(np.array([[0.5, 0.5]]) * SENSOR).min() > 0
