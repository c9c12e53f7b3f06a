"""The wire model against direct sums and areas."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import j0, j1

from udccal.models.bessel import bessel_j0_j1, sine_cosine
from udccal.models.geometry import Geometry, panel_points_mm, unproject
from udccal.models.wire import Wire, kappa, modulation, panel_rotation, slopes, waves, wire_map, wire_values

ROWS, COLUMNS = 48, 64
_values = jax.jit(wire_values, static_argnums=(2, 3))


def make_wire(pupil: float = 5.0) -> Wire:
    orders = [(n, m) for m in range(13) for n in range(-12, 13) if (m, n) > (0, 0)]
    fields = np.zeros((len(orders), 2, 2, 2))
    fields[:, 0, 0, 0] = 1.0
    return Wire(
        geometry=Geometry(
            focal_px=np.array([60.0, 60.0]),
            principal_point_px=np.array([31.5, 23.5]),
            distortion=np.array([-0.05, 0.01, 0.0, 0.0, 0.0]),
            rotation_rad=np.array([-0.3, 0.01, 0.02]),
            pupil_mm=np.array([10.0, 5.0, -14.0]),
        ),
        rotation_rad=np.zeros(3),
        standoff_per_pitch=22.0,
        offset_periods=np.array([0.3, 0.7]),
        footprint_per_pitch=pupil,
        row_open=0.4,
        column_open=0.9,
        depth_per_pitch=0.05,
        harmonics=np.array(orders, dtype=float),
        frequency=np.tile([1.0, 1.0], (len(orders), 1)),
        fields=fields,
        amplitudes=np.zeros((0, 2, 1, 1)),
        baseline=np.zeros((3, 3)),
    )


def test_bessel_functions() -> None:
    x = np.linspace(1e-3, 300, 20001)
    with jax.enable_x64(True):
        zero, one = (np.asarray(v) for v in jax.jit(bessel_j0_j1)(x))
    assert np.abs(zero - j0(x)).max() < 1e-7
    assert np.abs(one - j1(x)).max() < 1e-7


@pytest.mark.parametrize("ideal", [(0.1, -0.2), (-0.4, 0.3), (0.0, 0.0)])
def test_series_is_the_open_area_of_the_footprint(ideal: tuple[float, float]) -> None:
    wire = make_wire()
    with jax.enable_x64(True):
        point = np.array([ideal])
        slope = np.asarray(jax.jit(slopes)(wire, point))
        series = 1 + float(jax.jit(modulation)(wire, slope, np.zeros((1, 2)))[0])
        rotation = np.asarray(panel_rotation(wire))
    # Count points of the tilted pupil that fall into openings.
    rng = np.random.default_rng(0)
    radius, angle = np.sqrt(rng.random(400_000)), 2 * np.pi * rng.random(400_000)
    disc = np.stack([radius * np.cos(angle), radius * np.sin(angle)]) * 2.5
    on_panel = (rotation[:2, :2] - slope * rotation[2, :2]) @ disc + np.array([[0.3], [0.7]]) + 22.0 * slope
    half = (np.array([[0.9], [0.4]]) - 0.05 * np.abs(slope)) / 2
    is_open = np.all(np.abs(on_panel - np.rint(on_panel)) < half, axis=0)
    assert series == pytest.approx(is_open.mean() / np.prod(2 * half), abs=0.004)


def test_rays_follow_the_geometry() -> None:
    wire = make_wire()
    pixels = np.array([[5.0, 7.0], [40.0, 44.0]])
    with jax.enable_x64(True):
        points = np.asarray(jax.jit(panel_points_mm)(wire.geometry, pixels))
        found = np.asarray(jax.jit(lambda w, p: slopes(w, unproject(w.geometry, p)))(wire, pixels))
    assert np.allclose(found.T, (points - np.array([10.0, 5.0])) / 14.0, atol=1e-9)


def test_kappa_of_a_level_camera_is_the_order() -> None:
    wire = make_wire()
    level = Geometry(
        wire.geometry.focal_px, wire.geometry.principal_point_px, np.zeros(5), np.zeros(3), wire.geometry.pupil_mm
    )
    straight = Wire(**{**wire.__dict__, "geometry": level})
    seen = np.asarray(jax.jit(kappa)(straight, np.zeros((2, 1))))[:, 0]
    assert np.allclose(seen, np.hypot(*np.asarray(wire.harmonics).T), rtol=1e-6)


@pytest.mark.medium
def test_map_agrees_with_pixels_in_both_precisions() -> None:
    wire = make_wire()
    single = np.asarray(wire_map(wire, ROWS, COLUMNS))
    assert single.dtype == np.float32
    with jax.enable_x64(True):
        double = np.asarray(wire_map(wire, ROWS, COLUMNS))
        one = float(_values(wire, np.array([[13.0, 30.0]]), ROWS, COLUMNS)[0])
    assert double[30, 13] == pytest.approx(one, rel=1e-12)
    assert np.abs(single / double - 1).max() < 2e-4


@pytest.mark.medium
def test_no_harmonics_leave_the_shading() -> None:
    wire = make_wire()
    bare = Wire(
        **{
            **wire.__dict__,
            "harmonics": np.zeros((0, 2)),
            "frequency": np.zeros((0, 2)),
            "fields": np.zeros((0, 2, 2, 2)),
            "depth_per_pitch": 0.0,
        }
    )
    flat = np.asarray(wire_map(bare, ROWS, COLUMNS))
    assert np.allclose(flat, 0.36, rtol=1e-5)
    assert not np.allclose(np.asarray(wire_map(wire, ROWS, COLUMNS)), 0.36, rtol=1e-3)


@pytest.mark.medium
def test_an_amplitude_beside_the_pupils_is_a_polynomial_over_the_sensor() -> None:
    wire = make_wire()
    beside = np.zeros((1, 2, 2, 2))
    beside[0, 0, 1, 0], beside[0, 1, 0, 1] = 0.02, 0.03
    free = Wire(**{**wire.__dict__, "amplitudes": beside})
    pixels = np.array([[5.0, 40.0], [31.5, 23.5], [60.0, 2.0]])
    with jax.enable_x64(True):
        without, with_it = (np.asarray(_values(w, pixels, ROWS, COLUMNS)) for w in (wire, free))
        slope = slopes(wire, unproject(wire.geometry, pixels))
        periods = np.asarray(wire.offset_periods)[:, None] + wire.standoff_per_pitch * np.asarray(slope)
        cosine, sine = np.asarray(waves(wire, periods))[:, 0]
        base = without / (1 + np.asarray(modulation(wire, slope, np.zeros((3, 2)))))
    x, y = 2 * pixels[:, 0] / (COLUMNS - 1) - 1, 2 * pixels[:, 1] / (ROWS - 1) - 1
    np.testing.assert_allclose(with_it - without, base * (0.02 * y * cosine + 0.03 * x * sine), atol=1e-12)
    assert np.abs(with_it - without).max() > 1e-3


@pytest.mark.medium
def test_differentiable_in_its_shape() -> None:
    wire = make_wire()
    pixels = jnp.array([[13.0, 30.0], [50.0, 3.0]])

    @jax.jit
    def total(standoff: jax.Array) -> jax.Array:
        return wire_values(Wire(**{**wire.__dict__, "standoff_per_pitch": standoff}), pixels, ROWS, COLUMNS).sum()

    with jax.enable_x64(True):
        slope = float(jax.jit(jax.grad(total))(jnp.asarray(22.0)))
        numeric = float((total(jnp.asarray(22.0 + 1e-5)) - total(jnp.asarray(22.0 - 1e-5))) / 2e-5)
    assert slope == pytest.approx(numeric, rel=1e-4)


@pytest.mark.parametrize(("precision", "off"), [(np.float64, 4e-16), (np.float32, 2e-7)])
def test_the_quick_sine_and_cosine_are_exact_to_rounding(precision: type, off: float) -> None:
    x: np.ndarray = np.append(np.linspace(-400, 400, 100_001), np.arange(-40, 41) * np.pi / 4).astype(precision)
    with jax.enable_x64(True):
        found = [np.asarray(part) for part in jax.jit(sine_cosine)(x)]
    assert all(part.dtype == precision for part in found)
    for part, exact in zip(found, (np.sin(x.astype(np.float64)), np.cos(x.astype(np.float64))), strict=True):
        assert np.abs(part - exact).max() < off
