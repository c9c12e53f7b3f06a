"""Terms that do nothing."""

from __future__ import annotations

import numpy as np
import pytest

from udccal.fitting.nominal import absent_backscatter, absent_psf, absent_wire, nominal_geometry
from udccal.models.backscatter import backscatter_rate
from udccal.models.psf import psf_kernels
from udccal.models.wire import wire_map
from udccal.numerics import in_float64
from udccal.rig import RigDescription, load_rig


@pytest.fixture(scope="module", params=["lg55-reduced", "mk31-imx1600"])
def rig(request: pytest.FixtureRequest) -> RigDescription:
    return load_rig(request.param)


def test_the_wire_is_one(rig: RigDescription) -> None:
    wire = in_float64(lambda: np.asarray(wire_map(absent_wire(rig, nominal_geometry(rig)), 24, 32)))()
    assert np.abs(wire - 1.0).max() < 1e-12


@pytest.mark.medium
def test_the_panel_sends_nothing(rig: RigDescription) -> None:
    white = np.full((rig.panel.rows, rig.panel.columns, 3), 255, np.uint8)
    rate = in_float64(lambda: np.asarray(backscatter_rate(absent_backscatter(rig, nominal_geometry(rig)), white)))()
    assert rate.shape == (rig.camera.rows, rig.camera.columns)
    assert np.abs(rate).max() == 0.0


@pytest.mark.slow
def test_the_kernel_is_one_pixel(rig: RigDescription) -> None:
    place = np.array([[100.0, 200.0]])
    kernel = in_float64(lambda: np.asarray(psf_kernels(absent_psf(rig, nominal_geometry(rig)), place, 9, 7)))()
    assert np.abs(kernel[0, :, 4, 3] - 1.0).max() < 1e-12
    assert kernel.sum() == pytest.approx(3.0)
